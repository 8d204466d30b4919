"""The table of checks: each once, what it means, and what cures it.

The checks, their reports and ``docs/checks.md`` are all of this table.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import partial


class Severity(str, Enum):
    """How much a finding weighs, worst first; the words are SARIF's."""

    ERROR = "error"
    WARNING = "warning"
    NOTE = "note"

    @property
    def rank(self) -> int:
        """Its place among the others, 0 for the worst."""
        return list(Severity).index(self)

    def reaches(self, other: Severity) -> bool:
        """Whether it weighs at least as much."""
        return self.rank <= other.rank


@dataclass(frozen=True)
class Check:
    """One question that is asked of a repository.

    Attributes:
        id: Its name, in reports and for ``--allow``.
        sentence: What holds where it passes.
        cure: What an author changes where it does not.
    """

    severity: Severity
    id: str
    sentence: str
    cure: str


_error, _warning, _note = (partial(Check, severity) for severity in Severity)

CHECKS: dict[str, Check] = {
    check.id: check
    for check in (
        _error(
            "requirements",
            "What the repository declares can be read, resolved and installed.",
            "Write plain requirements that do not contradict each other: names, versions, markers.",
        ),
        _error(
            "imports",
            "Every package that its code imports is declared.",
            "Add the package to requirements.txt, or import it within try and except ImportError.",
        ),
        _error(
            "loads",
            "The entry file can be imported, and its make_env returns vector environments.",
            "Define make_env(n_envs, use_async_envs) and return a gymnasium.vector.VectorEnv, or "
            "{suite: {task: VectorEnv}}.",
        ),
        _error(
            "runs",
            "reset and step raise nothing, for actions sampled from the action space.",
            "Mend what raises it: reset has to work at any time, and step for every member of the "
            "action space.",
        ),
        _error(
            "survives",
            "No process of it dies, and each answer comes within its timeout.",
            "Keep to the limits of memory, processes and time, or say which ones it needs.",
        ),
        _error(
            "observation-space",
            "Every observation is a member of the observation space.",
            "Clip the observations, or widen the space.",
        ),
        _error(
            "observation-dtype",
            "Each sub-environment gives observations of the dtype and shape that its space says; "
            "Gymnasium casts what it puts into a batch, and so hides it.",
            "Return what observation_space says: for a float32 Box, np.asarray(..., np.float32).",
        ),
        _error(
            "observation-finite",
            "Observations have no NaN and no infinity, also where a space without bounds has them.",
            "Bound what they are computed from; give what is missing a value of its own.",
        ),
        _error(
            "step-types",
            "A step of one sub-environment gives a number, two bools and a dict, which Gymnasium "
            "casts into a batch, and so hides.",
            "Return float(reward), bool(terminated), bool(truncated) and a dict.",
        ),
        _warning(
            "num-envs",
            "make_env returns as many sub-environments as n_envs says.",
            "Make n_envs of them: gym.vector.SyncVectorEnv([make] * n_envs).",
        ),
        _error(
            "deadline",
            "All of it was judged within --deadline.",
            "Load, reset and step faster; or judge less of it (--task, --steps, --resets), or give "
            "it longer (--deadline).",
        ),
        _error(
            "rewards",
            "Rewards are finite numbers.",
            "Bound what the reward is computed from.",
        ),
        _warning(
            "infos",
            "Infos with a mask have an entry for each sub-environment, and so has the mask.",
            "Let Gymnasium's vector environments gather them; '_name' are booleans, one for each.",
        ),
        _warning(
            "large-infos",
            "Half of the steps have less than 512 KiB of info for each sub-environment.",
            "Put arrays into the observation, or give them by a method that is called for them.",
        ),
        _error(
            "seeding",
            "The same seed and the same actions give the same results in another process.",
            "Draw from self.np_random alone, after super().reset(seed=seed).",
        ),
        _error(
            "seed-ignored",
            "In one process the same seed and the same actions give the same results again, and so "
            "do resets without a seed that follow. Gymnasium's check_env refuses what does not.",
            "Let reset begin anew: super().reset(seed=seed), draw from self.np_random alone, and "
            "keep nothing of past episodes (running statistics, curricula).",
        ),
        _note(
            "seed-constant",
            "Another seed begins another episode.",
            "Nothing, where nothing is drawn by lot; else draw from self.np_random.",
        ),
        _warning(
            "seed-fixed",
            "Resets without a seed begin different episodes, where resets with seeds do.",
            "Seed only where reset is given a seed: super().reset(seed=seed) does it.",
        ),
        _warning(
            "actions-ignored",
            "Other actions give other results.",
            "Apply the action that step is given.",
        ),
        _warning(
            "endless",
            "Some episode ends within 10,000 steps by lot, as far as 30 seconds suffice for them.",
            "Terminate or truncate; gymnasium.wrappers.TimeLimit does it.",
        ),
        _error(
            "workers",
            "The results do not depend on the number of processes.",
            "Share nothing among sub-environments: no module-level state, no common generator.",
        ),
        _error(
            "autoreset",
            "It resets itself as metadata['autoreset_mode'] says.",
            "Let Gymnasium's vector environments do it, or follow the mode that is stated.",
        ),
        _note(
            "autoreset-stated",
            "metadata['autoreset_mode'] says how it resets itself.",
            "Set metadata['autoreset_mode'] to a member of gymnasium.vector.AutoresetMode.",
        ),
        _error(
            "render",
            "It renders what its mode says: rgb_array gives frames, uint8 of (height, width, 3), "
            "rgb_array_list lists of them, ansi texts. So it does in each of these modes that "
            "metadata['render_modes'] declares, where make_env takes a render_mode.",
            "Return that from render(), or declare the modes that there are.",
        ),
        _warning(
            "render-fps",
            "Where it renders frames, metadata['render_fps'] says how many make a second.",
            "Set metadata['render_fps'] to a number; LeRobot and RecordVideo read it.",
        ),
        _note(
            "lerobot",
            "LeRobot's policies can play it, beside loops of Gymnasium's vector environments.",
            "Nothing, where it is not for LeRobot; else see what `envhub init --lerobot` writes: "
            "agent_pos and pixels to observe, a Box of one dimension to act, _max_episode_steps.",
        ),
        _warning(
            "slow-steps",
            "Half of the steps take no longer than --slow-step says: a second.",
            "Compute less in a step, or once in reset; and never wait for a clock.",
        ),
        _warning(
            "slow-resets",
            "A reset takes no longer than five times what --slow-step says: five seconds.",
            "Load and compile once, when it is made, and not in each reset.",
        ),
        _warning(
            "denied-network",
            "It tries to reach no network that the policy denies.",
            "Bring data along in the repository, and report nothing to anybody.",
        ),
        _warning(
            "denied-files",
            "It asks to change no files but its own, and to read no homes, secrets or processes.",
            "Keep to the repository's folder, to tempfile and to the home that it is given.",
        ),
        _warning(
            "denied-kernel",
            "It tries no system call that the policy denies.",
            "Do without: no tracing, mounting or namespaces is needed to compute a step.",
        ),
        _warning(
            "limits-reached",
            "It uses up no limit: of processes and threads, open files, scratch, files in it.",
            "Use less, or say in the card what it needs, so that its user raises that limit.",
        ),
        _error(
            "leaks-processes",
            "Resets and steps leave no processes behind.",
            "End what an episode started before the next one begins, and wait for it.",
        ),
        _error(
            "leaks-threads",
            "Resets and steps leave no threads behind.",
            "Join what an episode started, or start it once.",
        ),
        _error(
            "leaks-files",
            "Resets and steps leave no files, sockets or pipes open.",
            "Close what an episode opened, or open it once.",
        ),
        _error(
            "leaks-memory",
            "Resets and steps leave no memory behind.",
            "Keep nothing of past episodes: no lists that grow, no caches without an end.",
        ),
        _note(
            "pinned",
            "The reference names a commit, so that what was judged is what will run.",
            "Write org/repo@COMMIT; the report says which one was judged.",
        ),
        _note(
            "licence",
            "A file says what one may do with it.",
            "Add a LICENSE file, or 'license:' at the head of README.md.",
        ),
        _note("card", "There is a README.md.", "Say what the environment is, and how it ends."),
        _note(
            "source-network",
            "Its code opens no connections.",
            "Bring data along in the repository: a sandbox has no network.",
        ),
        _note(
            "source-process",
            "Its code starts no programs.",
            "Do in Python what the program does, or say in the card which program it needs.",
        ),
        _note(
            "source-dynamic",
            "Its code is what is written: no eval, exec or compile of texts.",
            "Write the code out.",
        ),
        _note(
            "source-pickle",
            "Its code loads no pickles, which are programs.",
            "Keep weights and data as safetensors, npz without objects, or JSON.",
        ),
        _note(
            "source-native",
            "It brings no machine code and calls none by address.",
            "Depend on a package that brings the library along.",
        ),
        _error(
            "source-compiled",
            "It brings nothing compiled that runs in place of its source, whatever that says.",
            "Delete __pycache__, each .pyc, and each .so beside a .py of its name; in git with "
            "git rm -r --cached, and name them in .gitignore.",
        ),
        _error(
            "source-encoding",
            "Python reads its code as UTF-8; another encoding can make code of a comment.",
            "Save it as UTF-8, and name no encoding in its first two lines.",
        ),
        _error(
            "source-unparsed",
            "All of its Python has been read: files of up to 256 KiB, and 16 MiB in all.",
            "Put data into files of their own, and write what nests less deeply.",
        ),
        _error(
            "source-uncommitted",
            "The folder has what its commit has: no git repositories within it, no files that git "
            "does not look at or converts, no pointers of git LFS in place of files.",
            "Commit the files themselves, fetch them (git lfs pull), or have the commit judged.",
        ),
        _note(
            "source-ignored",
            "Git ignores nothing in the folder. What it ignores is not judged, loaded or pushed.",
            "Nothing, where it needs none of it; git add --force what it needs.",
        ),
        _note(
            "source-outside",
            "Its code names no places beyond its own: homes, /etc, /proc, other programs' tokens.",
            "Keep to the repository's folder and to tempfile; take the rest as an argument.",
        ),
        _warning(
            "source-hidden",
            "Its text is what one sees: no characters that are invisible, turn the order around, "
            "or look like others.",
            "Write them as escapes, such as \\u200b, or leave them out.",
        ),
        _note(
            "source-obscure",
            "Its code can be read: no lines of thousands of characters, no long texts of no words.",
            "Put data into files, and code on lines.",
        ),
        _note(
            "source-link",
            "Each file is what its name says, and no link to another.",
            "Put the file itself there.",
        ),
        _note(
            "source-unread",
            "Each file could be read: no archives, and no Python of another version.",
            "Bring no archives, and delete what no Python can run.",
        ),
    )
}

_DECLARE = (
    "Declare the package that the error names in requirements.txt, with the extra that it asks for."
)
_BRING = "Bring data along in the repository: a sandbox has no network."
_MEMORY = "Use less memory, or say in the card how much it needs: its user raises --memory."
_TIME = "Do less at once, or say in the card how long it takes: its user raises --timeout."
CURES = {
    **dict.fromkeys(("DependencyNotInstalled", "ImportError", "ModuleNotFoundError"), _DECLARE),
    **dict.fromkeys(
        ("NameNotFound", "NamespaceNotFound", "UnregisteredEnv", "VersionNotFound"),
        "Import the package that registers this id, and declare it in requirements.txt.",
    ),
    **dict.fromkeys(("ConnectionError", "HTTPError", "URLError", "gaierror"), _BRING),
    **dict.fromkeys(("MemoryError", "out-of-memory"), _MEMORY),
    **dict.fromkeys(("TimeoutError", "timeout"), _TIME),
    "FileNotFoundError": "Bring the file along in the repository, and find it from "
    "Path(__file__).parent.",
    "PermissionError": "Write to the working folder, to tempfile or to the home that it is given.",
    "NotImplementedError": "Implement the method that raises it.",
    "ResetNeeded": "Let every sub-environment be reset before it is stepped or rendered.",
    "cpu-limit": "Compute less, or say in the card how much: its user raises --cpu-time.",
    "disk-limit": "Write less, or say in the card how much: its user raises --disk.",
    "signal": "Look for a fault in native code: faulthandler.enable() prints where it is.",
    "exit": "Raise an exception instead of ending the process.",
}
"""What cures a finding whose error says more than its check, by the error's class or the process's
end."""
