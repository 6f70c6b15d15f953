"""The methods that are compared. Each is run on a whole recording and gives its trajectory and times per frame."""

import json
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path

import dexi_rs
import numpy as np
import yaml
from dex_retargeting.constants import HandType, RetargetingType, RobotName, get_default_config_path
from dex_retargeting.retargeting_config import RetargetingConfig

from hand import FINGERS, Hand

UNFILTERED = 1.0  # the peers' low-pass filters hand on their input


class Failure(Exception):
    """A method that cannot be run."""


@dataclass
class Run:
    q: np.ndarray  # (frames, 16), rad, in the order of the description
    p50_us: float
    p99_us: float
    poles: np.ndarray | None = None  # (frames, 4, 3), m, where the method itself tells
    whole_us: float | None = None  # per frame, of the whole process


class Peer:
    """dex-retargeting or dexi-rs with its own configuration file for this hand; only the URDF's path is ours."""

    def __init__(self, library: str, objective: str, filtered: bool, hand: Hand, urdf: Path):
        self.name = f"{library} {objective}" + ("" if filtered else ", no filter")
        self.library, self.hand = library, hand
        kind, side = RetargetingType[objective.lower()], HandType[hand.side]
        self.config = yaml.safe_load(get_default_config_path(RobotName.allegro, kind, side).read_text())["retargeting"]
        self.config["urdf_path"] = str(urdf)
        self.comment = f"low-pass alpha {self.config['low_pass_alpha']}" if filtered else "without its filter"
        if not filtered:
            self.config["low_pass_alpha"] = UNFILTERED

    def run(self, human: np.ndarray) -> Run:
        reference = RetargetingConfig.from_dict(dict(self.config)).build()
        origin, task = reference.optimizer.target_link_human_indices
        vectors = human[:, task] - human[:, origin]
        if self.library == "dexi-rs":
            retargeting = dexi_rs.load_config(self.config).build()
            vectors = [frame.ravel().tolist() for frame in vectors]  # what it takes; made outside the time
        else:
            retargeting = reference
        columns = [retargeting.joint_names.index(self.hand.peer_name(name)) for name in self.hand.joints]
        q, times = [], []
        for frame in vectors:
            began = time.perf_counter_ns()
            angles = retargeting.retarget(frame)
            times.append(1e-3 * (time.perf_counter_ns() - began))
            q.append(angles)
        return Run(np.array(q)[:, columns], np.percentile(times, 50), np.percentile(times, 99))


class Ours:
    """`robot retarget` as a process of its own, new for every run."""

    def __init__(self, name: str, arguments: list[str], robot: Path, hand: Hand, recording: Path, folder: Path):
        self.name, self.comment = name, " ".join(["robot retarget", *arguments])
        self.output, self.stats = folder / "frames.jsonl", folder / "stats.json"
        self.command = [robot, "retarget", "--hand", hand.side, "--input", recording, "--output", self.output]
        self.command += ["--stats", self.stats, *arguments]

    def run(self, human: np.ndarray) -> Run:
        began = time.perf_counter()
        done = subprocess.run(self.command, capture_output=True, text=True)
        whole = time.perf_counter() - began
        if done.returncode != 0:
            raise Failure(f"{' '.join(map(str, self.command))}\n{done.stderr.strip()}")
        rows = [json.loads(line) for line in self.output.read_text().splitlines()]
        if len(rows) != len(human):
            raise Failure(f"{len(rows)} frames come back for {len(human)}")
        step = json.loads(self.stats.read_text())["step_us"]
        poles = np.array([[row["p"][finger] for finger in FINGERS] for row in rows])
        return Run(np.array([row["q"] for row in rows]), step["p50"], step["p99"], poles, 1e6 * whole / len(rows))


def ours(robot: Path, more: list[str], *where) -> list[Ours]:
    """What this build of `robot` can do, with the arguments `more` for each."""
    variants = {
        "ours": [],
        "ours, conditioned": ["--conditioning", "on"],
        "ours vector": ["--mode", "vector"],
        "ours DexPilot": ["--mode", "dexpilot"],
    }
    def known(arguments: list[str]) -> bool:
        # clap looks at the arguments in their order, and refuses a wrong one before it comes to --help.
        return subprocess.run([robot, "retarget", *arguments, "--help"], capture_output=True).returncode == 0

    return [Ours(name, args + more, robot, *where) for name, args in variants.items() if known(args)]


def peers(*where) -> list[Peer]:
    return [
        Peer(library, objective, filtered, *where)
        for library in ("dex-retargeting", "dexi-rs")
        for objective in ("vector", "DexPilot")
        for filtered in (True, False)
    ]
