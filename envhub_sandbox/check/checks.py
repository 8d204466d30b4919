"""What is judged: each check once, what it means, and what cures it.

The checks, their reports and ``docs/checks.md`` are all of this table.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


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
        severity: Of its findings.
        sentence: What holds where it passes.
        cure: What an author changes where it does not.
    """

    id: str
    severity: Severity
    sentence: str
    cure: str


_E, _W, _N = Severity.ERROR, Severity.WARNING, Severity.NOTE

CHECKS: dict[str, Check] = {
    check.id: check
    for check in (
        Check(
            "requirements",
            _E,
            "What the repository declares can be read, resolved and installed.",
            "Write plain requirements that do not contradict each other: names, versions, markers.",
        ),
        Check(
            "imports",
            _E,
            "Every package that its code imports is declared.",
            "Add the package to requirements.txt, or import it within try and except ImportError.",
        ),
        Check(
            "loads",
            _E,
            "The entry file can be imported, and its make_env returns vector environments.",
            "Define make_env(n_envs, use_async_envs) and return a gymnasium.vector.VectorEnv, or "
            "{suite: {task: VectorEnv}}.",
        ),
        Check(
            "runs",
            _E,
            "reset and step raise nothing, for actions sampled from the action space.",
            "Mend what raises it: reset has to work at any time, and step for every member of the "
            "action space.",
        ),
        Check(
            "survives",
            _E,
            "No process of it dies, and each answer comes within its timeout.",
            "Keep to the limits of memory, processes and time, or say which ones it needs.",
        ),
        Check(
            "observation-space",
            _E,
            "Every observation is a member of the observation space.",
            "Clip the observations, or widen the space.",
        ),
        Check(
            "observation-dtype",
            _E,
            "Each sub-environment gives observations of the dtype and shape that its space says; "
            "Gymnasium casts what it puts into a batch, and so hides it.",
            "Return what observation_space says: for a float32 Box, np.asarray(..., np.float32).",
        ),
        Check(
            "observation-finite",
            _E,
            "Observations have no NaN and no infinity, also where a space without bounds has them.",
            "Bound what they are computed from; give what is missing a value of its own.",
        ),
        Check(
            "step-types",
            _E,
            "A step of one sub-environment gives a number, two bools and a dict, which Gymnasium "
            "casts into a batch, and so hides.",
            "Return float(reward), bool(terminated), bool(truncated) and a dict.",
        ),
        Check(
            "num-envs",
            _W,
            "make_env returns as many sub-environments as n_envs says.",
            "Make n_envs of them: gym.vector.SyncVectorEnv([make] * n_envs).",
        ),
        Check(
            "deadline",
            _E,
            "All of it was judged within --deadline.",
            "Load, reset and step faster; or judge less of it (--task, --steps, --resets), or give "
            "it longer (--deadline).",
        ),
        Check(
            "rewards",
            _E,
            "Rewards are finite numbers.",
            "Bound what the reward is computed from.",
        ),
        Check(
            "infos",
            _W,
            "Infos with a mask have an entry for each sub-environment, and so has the mask.",
            "Let Gymnasium's vector environments gather them; '_name' are booleans, one for each.",
        ),
        Check(
            "large-infos",
            _W,
            "Half of the steps have less than 512 KiB of info for each sub-environment.",
            "Put arrays into the observation, or give them by a method that is called for them.",
        ),
        Check(
            "seeding",
            _E,
            "The same seed and the same actions give the same results in another process.",
            "Draw from self.np_random alone, after super().reset(seed=seed).",
        ),
        Check(
            "seed-ignored",
            _E,
            "In one process the same seed and the same actions give the same results again, and so "
            "do resets without a seed that follow. Gymnasium's check_env refuses what does not.",
            "Let reset begin anew: super().reset(seed=seed), draw from self.np_random alone, and "
            "keep nothing of past episodes (running statistics, curricula).",
        ),
        Check(
            "seed-constant",
            _N,
            "Another seed begins another episode.",
            "Nothing, where nothing is drawn by lot; else draw from self.np_random.",
        ),
        Check(
            "seed-fixed",
            _W,
            "Resets without a seed begin different episodes, where resets with seeds do.",
            "Seed only where reset is given a seed: super().reset(seed=seed) does it.",
        ),
        Check(
            "actions-ignored",
            _W,
            "Other actions give other results.",
            "Apply the action that step is given.",
        ),
        Check(
            "endless",
            _W,
            "Some episode ends within 10,000 steps by lot, as far as 30 seconds suffice for them.",
            "Terminate or truncate; gymnasium.wrappers.TimeLimit does it.",
        ),
        Check(
            "workers",
            _E,
            "The results do not depend on the number of processes.",
            "Share nothing among sub-environments: no module-level state, no common generator.",
        ),
        Check(
            "autoreset",
            _E,
            "It resets itself as metadata['autoreset_mode'] says.",
            "Let Gymnasium's vector environments do it, or follow the mode that is stated.",
        ),
        Check(
            "autoreset-stated",
            _N,
            "metadata['autoreset_mode'] says how it resets itself.",
            "Set metadata['autoreset_mode'] to a member of gymnasium.vector.AutoresetMode.",
        ),
        Check(
            "render",
            _E,
            "It renders what its mode says: rgb_array gives frames, uint8 of (height, width, 3), "
            "rgb_array_list lists of them, ansi texts. So it does in each of these modes that "
            "metadata['render_modes'] declares, where make_env takes a render_mode.",
            "Return that from render(), or declare the modes that there are.",
        ),
        Check(
            "render-fps",
            _W,
            "Where it renders frames, metadata['render_fps'] says how many make a second.",
            "Set metadata['render_fps'] to a number; LeRobot and RecordVideo read it.",
        ),
        Check(
            "slow-steps",
            _W,
            "Half of the steps take no longer than --slow-step says: a second.",
            "Compute less in a step, or once in reset; and never wait for a clock.",
        ),
        Check(
            "slow-resets",
            _W,
            "A reset takes no longer than five times what --slow-step says: five seconds.",
            "Load and compile once, when it is made, and not in each reset.",
        ),
        Check(
            "denied-network",
            _W,
            "It tries to reach no network that the policy denies.",
            "Bring data along in the repository, and report nothing to anybody.",
        ),
        Check(
            "denied-files",
            _W,
            "It asks to change no files but its own, and to read no homes, secrets or processes.",
            "Keep to the repository's folder, to tempfile and to the home that it is given.",
        ),
        Check(
            "denied-kernel",
            _W,
            "It tries no system call that the policy denies.",
            "Do without: no tracing, mounting or namespaces is needed to compute a step.",
        ),
        Check(
            "limits-reached",
            _W,
            "It uses up no limit: of processes and threads, open files, scratch, files in it.",
            "Use less, or say in the card what it needs, so that its user raises that limit.",
        ),
        Check(
            "leaks-processes",
            _E,
            "Resets and steps leave no processes behind.",
            "End what an episode started before the next one begins, and wait for it.",
        ),
        Check(
            "leaks-threads",
            _E,
            "Resets and steps leave no threads behind.",
            "Join what an episode started, or start it once.",
        ),
        Check(
            "leaks-files",
            _E,
            "Resets and steps leave no files, sockets or pipes open.",
            "Close what an episode opened, or open it once.",
        ),
        Check(
            "leaks-memory",
            _E,
            "Resets and steps leave no memory behind.",
            "Keep nothing of past episodes: no lists that grow, no caches without an end.",
        ),
        Check(
            "pinned",
            _N,
            "The reference names a commit, so that what was judged is what will run.",
            "Write org/repo@COMMIT; the report says which one was judged.",
        ),
        Check(
            "licence",
            _N,
            "A file says what one may do with it.",
            "Add a LICENSE file, or 'license:' at the head of README.md.",
        ),
        Check("card", _N, "There is a README.md.", "Say what the environment is, and how it ends."),
        Check(
            "source-network",
            _N,
            "Its code opens no connections.",
            "Bring data along in the repository: a sandbox has no network.",
        ),
        Check(
            "source-process",
            _N,
            "Its code starts no programs.",
            "Do in Python what the program does, or say in the card which program it needs.",
        ),
        Check(
            "source-dynamic",
            _N,
            "Its code is what is written: no eval, exec or compile of texts.",
            "Write the code out.",
        ),
        Check(
            "source-pickle",
            _N,
            "Its code loads no pickles, which are programs.",
            "Keep weights and data as safetensors, npz without objects, or JSON.",
        ),
        Check(
            "source-native",
            _N,
            "It brings no machine code and calls none by address.",
            "Depend on a package that brings the library along.",
        ),
        Check(
            "source-compiled",
            _E,
            "It brings nothing compiled that runs in place of its source, whatever that says.",
            "Delete __pycache__, each .pyc, and each .so beside a .py of its name; in git with "
            "git rm -r --cached, and name them in .gitignore.",
        ),
        Check(
            "source-encoding",
            _E,
            "Python reads its code as UTF-8; another encoding can make code of a comment.",
            "Save it as UTF-8, and name no encoding in its first two lines.",
        ),
        Check(
            "source-unparsed",
            _E,
            "All of its Python has been read: files of up to 256 KiB, and 16 MiB in all.",
            "Put data into files of their own, and write what nests less deeply.",
        ),
        Check(
            "source-uncommitted",
            _E,
            "The folder has what its commit has: no git repositories within it, no files that git "
            "does not look at or converts, no pointers of git LFS in place of files.",
            "Commit the files themselves, fetch them (git lfs pull), or have the commit judged.",
        ),
        Check(
            "source-ignored",
            _N,
            "Git ignores nothing in the folder. What it ignores is not judged, loaded or pushed.",
            "Nothing, where it needs none of it; git add --force what it needs.",
        ),
        Check(
            "source-outside",
            _N,
            "Its code names no places beyond its own: homes, /etc, /proc, other programs' tokens.",
            "Keep to the repository's folder and to tempfile; take the rest as an argument.",
        ),
        Check(
            "source-hidden",
            _W,
            "Its text is what one sees: no characters that are invisible, turn the order around, "
            "or look like others.",
            "Write them as escapes, such as \\u200b, or leave them out.",
        ),
        Check(
            "source-obscure",
            _N,
            "Its code can be read: no lines of thousands of characters, no long texts of no words.",
            "Put data into files, and code on lines.",
        ),
        Check(
            "source-link",
            _N,
            "Each file is what its name says, and no link to another.",
            "Put the file itself there.",
        ),
        Check(
            "source-unread",
            _N,
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
