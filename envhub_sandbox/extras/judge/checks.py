"""The table of checks: the meaning of each check, and the cure for its findings.

The checks, their reports and ``docs/checks.md`` use this table.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum


class Severity(str, Enum):
    """The severity of a finding, worst first, in SARIF's words."""

    ERROR = "error"
    WARNING = "warning"
    NOTE = "note"

    @property
    def rank(self) -> int:
        """Returns the position in the order, 0 for the worst."""
        return list(Severity).index(self)

    def reaches(self, other: Severity) -> bool:
        """Tells whether this severity is at least as severe as another."""
        return self.rank <= other.rank


@dataclass(frozen=True)
class Check:
    """One check of a repository.

    Attributes:
        id: Its name, in reports and for ``--allow``.
        sentence: A statement that is true if the check passes.
        cure: The change that an author makes if the check fails.
    """

    severity: Severity
    id: str
    sentence: str
    cure: str


_TABLE = r"""
error requirements
    The declared packages can be read, resolved and installed.
    Cure: Write plain requirements (names, versions, markers) that do not contradict each other.
error imports
    Every imported package is declared.
    Cure: Add the package to requirements.txt, or import it in a try block with except
    ImportError.
error loads
    The entry file can be imported, and its make_env returns vector environments.
    Cure: Mend what the import raises, and have make_env(n_envs, use_async_envs) return a
    gymnasium.vector.VectorEnv, or {suite: {task: VectorEnv}}.
error runs
    reset and step raise no exception for actions sampled from the action space.
    Cure: Fix what raises: reset must work at any time, and step for every member of the action
    space.
error survives
    No process dies, and each answer comes within its timeout.
    Cure: Stay within the limits of memory, processes and time, or say in the card which are
    needed.
error observation-space
    Every observation is a member of the observation space.
    Cure: Clip the observations, or widen the space.
error observation-dtype
    Each sub-environment returns observations with the dtype and shape of its space. (Gymnasium
    casts them into a batch, which hides a difference.) So do a vector class's own batches.
    Cure: Return the dtype of observation_space: for a float32 Box, np.asarray(..., np.float32).
error observation-finite
    Observations have no NaN and no infinity, also if the space has no bounds.
    Cure: Bound the inputs of the computation, and give missing values a value of their own.
error step-types
    step of one sub-environment returns a number, two bools and a dict. (Gymnasium casts them
    into a batch, which hides other types.)
    Cure: Return float(reward), bool(terminated), bool(truncated) and a dict.
warning num-envs
    make_env returns n_envs sub-environments.
    Cure: Make n_envs of them: gym.vector.SyncVectorEnv([make] * n_envs).
error deadline
    Everything was judged within --deadline.
    Cure: Load, reset and step faster; or judge less (--task, --steps, --resets), or raise
    --deadline.
error rewards
    Rewards are finite numbers.
    Cure: Bound the inputs of the reward.
warning infos
    Infos with a mask, and the mask, have an entry for each sub-environment.
    Cure: Let Gymnasium's vector environments collect the infos; a mask '_name' has one boolean
    for each.
note info-types
    Infos are numbers, texts, arrays, and lists and dicts of them. Of anything else only a
    description leaves the sandbox.
    Cure: Put plain values into infos, or offer a method that is called when needed.
warning large-infos
    Half of the steps have less than 512 KiB of info for each sub-environment.
    Cure: Put arrays into the observation, or return them from a method that is called when
    needed.
error seeding
    The same seed and actions give the same results in another process.
    Cure: Draw only from self.np_random, after super().reset(seed=seed).
error seed-ignored
    In one process, the same seed and actions give the same results again; so do the resets
    without a seed that follow. (Gymnasium's check_env requires this, too.)
    Cure: Let reset start anew: call super().reset(seed=seed), draw only from self.np_random,
    and keep nothing of past episodes (a curriculum, running statistics other than Gymnasium's).
note seed-constant
    Another seed starts another episode.
    Cure: If nothing is random, change nothing. Otherwise draw from self.np_random.
warning seed-fixed
    Resets without a seed start different episodes, if resets with seeds do.
    Cure: Seed only if reset gets a seed: super().reset(seed=seed) does this.
warning actions-ignored
    Other actions give other results.
    Cure: Apply the action that step receives.
warning endless
    With random actions an episode ends within 10,000 steps, or does so by its TimeLimit or
    max_episode_steps if these take longer than 30 seconds.
    Cure: Terminate or truncate, for example with gymnasium.wrappers.TimeLimit.
note endless-unknown
    It was seen within 30 seconds whether an episode ends, or a TimeLimit or
    max_episode_steps says when.
    Cure: If steps have to be slow, change nothing; a limit of gymnasium.wrappers.TimeLimit
    counts as an end.
error workers
    The results do not depend on the number of processes.
    Cure: Share nothing among sub-environments: no module-level state, no common generator.
error autoreset
    It resets itself as metadata['autoreset_mode'] says.
    Cure: Let Gymnasium's vector environments reset, or follow the stated mode.
note autoreset-stated
    metadata['autoreset_mode'] says how it resets itself.
    Cure: Set metadata['autoreset_mode'] to a member of gymnasium.vector.AutoresetMode.
error render
    render returns what its mode requires: uint8 frames of (height, width, 3) for rgb_array,
    lists of them for rgb_array_list, text for ansi. If make_env takes a render_mode, this holds
    for each of these modes in metadata['render_modes'].
    Cure: Return that from render(), or declare only the modes that work.
warning render-fps
    If it renders frames, metadata['render_fps'] is their number for each second.
    Cure: Set metadata['render_fps'] to a number; LeRobot and RecordVideo read it.
note lerobot
    LeRobot's policies can play it, not only code for Gymnasium's vector environments.
    Cure: If it is not for LeRobot, change nothing. Otherwise see what `envhub init --lerobot`
    writes: observations agent_pos and pixels, a Box of one dimension as action,
    _max_episode_steps, a whole number as metadata['render_fps'], and info['is_success'] at the end
    of an episode.
warning slow-steps
    Half of the steps take at most --slow-step, one second by default.
    Cure: Compute less in a step, or once in reset; do not wait for a clock.
warning slow-resets
    A reset takes at most five times --slow-step, five seconds by default.
    Cure: Load and compile once, when the environment is made, and not in each reset.
warning denied-network
    It does not try to use a network that the policy denies.
    Cure: Put the data into the repository, and send nothing.
warning denied-files
    It does not try to change files outside its own folders, or to read homes, secrets or other
    processes.
    Cure: Use only the repository's folder, tempfile and the home that the jail has.
warning denied-kernel
    It makes no system call that the policy denies.
    Cure: Avoid the call: a step needs no tracing, mounting or namespaces.
warning limits-reached
    It reaches no limit of processes and threads, open files, scratch space, or files there.
    Cure: Use less, or say in the card what it needs, so that a user can raise the limit.
error leaks-processes
    Resets and steps leave no processes behind.
    Cure: End what an episode started before the next one begins, and wait for it.
error leaks-threads
    Resets and steps leave no threads behind.
    Cure: Join what an episode started, or start it once.
error leaks-files
    Resets and steps leave no files, sockets or pipes open.
    Cure: Close what an episode opened, or open it once.
error leaks-memory
    Resets and steps leave no memory behind.
    Cure: Keep nothing of past episodes: no growing lists, no caches without a limit.
note pinned
    The reference names a commit, so the files that were judged are the files that will run.
    Cure: Write org/repo@COMMIT; the report says which commit was judged.
note licence
    A file states the licence.
    Cure: Add a LICENSE file, or 'license:' at the head of README.md.
note card
    There is a README.md.
    Cure: Describe the environment, and how it ends.
note source-network
    The code opens no connections.
    Cure: Put the data into the repository: a sandbox has no network.
note source-process
    The code starts no programs.
    Cure: Do the same in Python, or say in the card which program it needs.
note source-dynamic
    The code does not run text as code: no eval, exec or compile.
    Cure: Write the code out.
note source-pickle
    The code loads no pickles, which can execute code.
    Cure: Store weights and data as safetensors, npz without objects, or JSON.
note source-native
    The repository has no machine code and calls none by address.
    Cure: Depend on a package that has the library.
error source-compiled
    The repository has no compiled Python, which runs instead of its source.
    Cure: Delete __pycache__, each .pyc, and each .so beside a .py of its name; in git with git
    rm -r --cached, and name them in .gitignore.
error source-encoding
    The code is UTF-8; with another encoding, a comment can be code.
    Cure: Save it as UTF-8, and name no encoding in its first two lines.
error source-unparsed
    All Python files were parsed, up to 256 KiB each and 16 MiB in all.
    Cure: Put data into other files, and nest the code less deeply.
error source-uncommitted
    The folder has what its commit has: no nested git repositories, no files that git does not
    look at or converts, no git LFS pointers instead of files.
    Cure: Commit the files themselves, download them (git lfs pull), or judge the commit.
note source-ignored
    Nothing of the folder is left out: ignored by git, unreadable, or a virtual environment. What
    is left out is not judged, loaded or pushed.
    Cure: If it needs none of it, change nothing; otherwise git add --force what it needs.
note source-outside
    The code names no paths outside its own: homes, /etc, /proc, other programs' tokens.
    Cure: Use only the repository's folder and tempfile; take other paths as arguments.
warning source-hidden
    The text is what a reader sees: no characters that are invisible, reverse the direction, or
    look like others.
    Cure: Write them as escapes, such as \u200b, or remove them.
note source-obscure
    The code is readable: no lines of thousands of characters, no long encoded texts.
    Cure: Put data into files, and break long lines.
note source-link
    No file is a link to another.
    Cure: Put the file itself there.
note source-unread
    Each file can be read: no archives, and no Python of another version.
    Cure: Remove archives, and files that no supported Python can parse.
"""


def _checks() -> Iterator[Check]:
    """Parses the table: a line with severity and id, and below it the sentence and the cure."""
    for entry in re.split(r"\n(?=\w)", _TABLE.rstrip())[1:]:
        severity, name, text = entry.split(maxsplit=2)
        sentence, _, cure = " ".join(text.split()).partition(" Cure: ")
        yield Check(Severity(severity), name, sentence, cure)


CHECKS: dict[str, Check] = {check.id: check for check in _checks()}

_DECLARE = (
    "Declare the package that the error names in requirements.txt, with the extra that it needs."
)
_BRING = "Put the data into the repository: a sandbox has no network."
_MEMORY = "Use less memory, or say in the card how much it needs: a user can raise --memory."
_TIME = "Do less at once, or say in the card how long it takes: a user can raise --timeout."
CURES = {
    **dict.fromkeys(("DependencyNotInstalled", "ImportError", "ModuleNotFoundError"), _DECLARE),
    **dict.fromkeys(
        ("NameNotFound", "NamespaceNotFound", "UnregisteredEnv", "VersionNotFound"),
        "Import the package that registers this id, and declare it in requirements.txt.",
    ),
    **dict.fromkeys(("ConnectionError", "HTTPError", "URLError", "gaierror"), _BRING),
    **dict.fromkeys(("MemoryError", "out-of-memory"), _MEMORY),
    **dict.fromkeys(("TimeoutError", "timeout"), _TIME),
    "returned": "Return what the spaces say: observations with the keys, shape and kind of numbers "
    "of observation_space, a number, two bools and a dict; or change the space.",
    "FileNotFoundError": "Put the file into the repository, and open it relative to "
    "Path(__file__).parent.",
    "PermissionError": "Write to the working folder, to tempfile or to the home that the jail has.",
    "NotImplementedError": "Implement the method that raises it.",
    "ResetNeeded": "Reset every sub-environment before it is stepped or rendered.",
    "cpu-limit": "Compute less, or say in the card how much: a user can raise --cpu-time.",
    "disk-limit": "Write less, or say in the card how much: a user can raise --disk.",
    "signal": "Find the fault in native code: faulthandler.enable() prints its place.",
    "exit": "Raise an exception instead of ending the process.",
}
"""More specific cures than the check's, by the class of an error or by the end of a process."""
