"""Runs all methods on one recording, in turns, and writes compare.md, compare.json and compare.csv. See README.md."""

import argparse
import csv
import importlib.metadata
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

# Before numpy and torch are loaded: one thread for everybody.
os.environ["OMP_NUM_THREADS"] = "1"

import dexi_rs
import numpy as np

import methods
import metrics
from hand import FINGERS, Hand

HERE = Path(__file__).resolve().parent
COLUMNS = 2 + 3 * 21
SAME_POINT = 1e-9  # m


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--recording", type=Path, required=True)
    parser.add_argument("--hand", choices=("right", "left"), required=True)
    parser.add_argument("--robot", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--rounds", type=int, required=True)
    parser.add_argument("--pinch", type=float, required=True, help="mm")
    parser.add_argument("robot_options", nargs="*")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    pinch = 1e-3 * arguments.pinch
    times, human, mirrored = read(arguments.recording, arguments.hand)
    hand = Hand(HERE.parents[1] / "urdf", arguments.hand)
    load = [os.getloadavg()[0]]
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        recording = arguments.recording
        if mirrored:
            recording = folder / "mirrored.csv"
            write(recording, arguments.recording.open().readline().strip(), times, human)
        urdf = folder / "hand.urdf"
        hand.write_peer_urdf(urdf)
        theirs = dexi_rs.asset_path(f"robots/hands/allegro_hand/allegro_hand_{hand.side}.urdf")
        if (worst := hand.check_peer_urdf(urdf, theirs)) > SAME_POINT:
            sys.exit(f"error: our hand differs by {worst:.2g} m or rad from the one that dexi-rs ships")
        everyone = methods.ours(arguments.robot, arguments.robot_options, hand, recording, folder)
        everyone += methods.peers(hand, urdf)
        results = compete(everyone, human, arguments.rounds)
    load.append(os.getloadavg()[0])

    for name, runs in results.items():
        check_points(name, hand, runs[0])
    report = {
        "recording": arguments.recording.name,
        "mirrored": mirrored,
        "frames": len(human),
        "rate_hz": 1 / float(np.median(np.diff(times))),
        "hand": hand.side,
        "rounds": arguments.rounds,
        "machine": machine(load),
        "versions": versions(),
        "pinch_mm": arguments.pinch,
        "human_pinches": metrics.human_pinches(human, pinch),
        "methods": [
            {**timing(method, runs), **metrics.measure(hand, human, times, runs[0].q, pinch)}
            for method in everyone
            for runs in [results[method.name]]
        ],
    }
    base = report["methods"][0]["time_us"]
    for method in report["methods"]:
        method["time_ratio"] = {key: method["time_us"][key] / base[key] for key in ("p50", "p99")}
    report = rounded(report)
    (arguments.out / "compare.json").write_text(json.dumps(report, indent=1) + "\n")
    text = markdown(report)
    (arguments.out / "compare.md").write_text(text)
    write_csv(arguments.out / "compare.csv", report["methods"])
    print(text)


def read(path: Path, side: str) -> tuple[np.ndarray, np.ndarray, bool]:
    """Times (s) and keypoints (frames, 21, 3) of a hand of that side; whether they were mirrored for it."""
    try:
        table = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)
    except (OSError, ValueError) as error:
        sys.exit(f"error: {path}: {error}")
    if len(table) < 3 or table.shape[1] != COLUMNS or not np.isfinite(table).all():
        sys.exit(f"error: {path}: it takes 3 or more rows of frame, time_s and x, y, z of 21 keypoints (m), all finite")
    times, human = table[:, 1], table[:, 2:].reshape(-1, 21, 3)
    if not (np.diff(times) > 0).all():
        sys.exit(f"error: {path}: time_s does not grow in row {int(np.argmin(np.diff(times) > 0)) + 3}")
    human = human - human[:, :1]
    # The peers do not find the hand's frame by themselves: x out of the palm, z from the wrist to the middle knuckle.
    middle = human[:, 9].mean(axis=0)
    curl = (human[:, [8, 12, 16]] - human[:, [5, 9, 13]]).mean(axis=(0, 1))
    across = (human[:, 5] - human[:, 17]).mean(axis=0)
    if middle[2] < 0.94 * np.linalg.norm(middle) or abs(across[1]) < 0.7 * np.linalg.norm(across) or curl[0] <= 0:
        sys.exit(f"error: {path}: turn the keypoints into the hand first: z to the middle knuckle, x out of the palm")
    mirrored = bool(across[1] > 0) != (side == "right")
    if mirrored:
        human = human * [1, -1, 1]
    return times, human, mirrored


def write(path: Path, header: str, times: np.ndarray, human: np.ndarray) -> None:
    rows = np.column_stack([np.arange(len(times)), times, human.reshape(-1, 63)])
    np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt=["%d", "%.6f"] + ["%.7f"] * 63)


def compete(everyone: list, human: np.ndarray, rounds: int) -> dict[str, list[methods.Run]]:
    """Every round runs every method once, each round in another order, so that the machine's load hits all alike."""
    results = {method.name: [] for method in everyone}
    for turn in range(rounds):
        start = turn * len(everyone) // rounds
        for method in everyone[start:] + everyone[:start]:
            print(f"round {turn + 1}/{rounds}: {method.name}", file=sys.stderr, flush=True)
            try:
                results[method.name].append(method.run(human))
            except methods.Failure as failure:
                sys.exit(f"error: {method.name}: {failure}")
    return results


def check_points(name: str, hand: Hand, run: methods.Run) -> None:
    """The fingertips that a method reports are those of its joint angles, by the one forward kinematics."""
    if run.poles is not None:
        worst = np.abs(hand.tips(run.q)[0] - run.poles).max()
        if not worst < SAME_POINT:
            sys.exit(f"error: {name}: its p differs by {worst:.2g} m from Pinocchio's forward kinematics of its q")
        print(f"{name}: its p is Pinocchio's forward kinematics of its q to {worst:.1e} m", file=sys.stderr)


def timing(method, runs: list[methods.Run]) -> dict:
    time = {key: statistics.median(getattr(run, f"{key}_us") for run in runs) for key in ("p50", "p99")}
    time["of_each_round"] = [[run.p50_us, run.p99_us] for run in runs]
    if runs[0].whole_us is not None:
        time["whole_process_per_frame"] = statistics.median(run.whole_us for run in runs)
    return {"name": method.name, "what": method.comment, "time_us": time}


def machine(load: list[float]) -> dict:
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    model = next((line.partition(": ")[2] for line in lines if line.startswith("model name")), platform.machine())
    return {"cpu": model, "cores": os.cpu_count(), "load_before_and_after": load}


def versions() -> dict:
    names = ("dex_retargeting", "dexi-rs", "nlopt", "torch", "pin", "numpy")
    git = subprocess.run(["git", "-C", HERE, "describe", "--always", "--dirty"], capture_output=True, text=True)
    return {
        "this project": git.stdout.strip() or "unknown",
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in names},
    }


def rounded(value):
    """Four digits are more than any of these figures is worth; numpy's numbers become Python's."""
    if isinstance(value, dict):
        return {key: rounded(item) for key, item in value.items()}
    if isinstance(value, list):
        return [rounded(item) for item in value]
    if isinstance(value, (float, np.floating)):
        return float(f"{value:.4g}")
    return value


def markdown(report: dict) -> str:
    human = report["human_pinches"]
    pinches = ", ".join(
        f"{finger} {gap['frames']}" + (f" (mean {gap['mean_mm']:.1f} mm)" if gap["frames"] else "")
        for finger, gap in human.items()
    )
    lines = [
        "# Side by side with the peers",
        "",
        f"`{report['recording']}`{' (mirrored)' if report['mirrored'] else ''}, {report['frames']} frames at "
        f"{report['rate_hz']:.3g} Hz, Allegro V4 {report['hand']}; rounds: {report['rounds']}. Frames in which the "
        f"human pinches (keypoints closer than {report['pinch_mm']:g} mm): {pinches}.",
        "",
        f"{report['machine']['cpu']}, {report['machine']['cores']} cores, load "
        f"{' to '.join(f'{load:.1f}' for load in report['machine']['load_before_and_after'])}; "
        + ", ".join(f"{name} {version}" for name, version in report["versions"].items())
        + ".",
        "",
        "## Time per frame",
        "",
    ]
    rows = [
        (
            method["name"],
            method["what"],
            plain(method["time_us"]["p50"]),
            plain(method["time_us"]["p99"]),
            plain(method["time_ratio"]["p50"]),
            plain(method["time_ratio"]["p99"]),
            plain(method["time_us"].get("whole_process_per_frame")),
        )
        for method in report["methods"]
    ]
    header = ("method", "what", "p50 us", "p99 us", "p50 ratio", "p99 ratio", "whole process us")
    lines += [*table(header, rows), "", "## Contact", ""]
    rows = []
    for method in report["methods"]:
        gaps = [
            plain(method["pinch_gap"][finger][key])
            for finger in FINGERS[1:]
            for key in ("mean_mm", "p95_mm")
        ]
        same = [f"{method['correlation'][finger]:.2f}" for finger in FINGERS[1:]]
        lags = [f"{method['lag_frames'][finger]}" for finger in FINGERS[1:]]
        overlap = f"{method['tips_overlap_frames']} ({method['worst_tip_overlap_mm']:.2g} mm)"
        pairs = [f"{gaps[i]} / {gaps[i + 1]}" for i in (0, 2, 4)]
        rows.append((method["name"], *pairs, " / ".join(same), " / ".join(lags), overlap))
    header = ("method", *(f"gap {finger}, mean / p95 mm" for finger in FINGERS[1:]))
    header += ("correlation I / M / R", "lag I / M / R, frames", "tips overlap, frames (worst)")
    lines += [*table(header, rows), "", "## Motion and shape", ""]
    rows = [
        (
            method["name"],
            f"{method['mean_second_difference_mrad']:.3g}",
            f"{method['max_step_rad']:.3g}",
            f"{method['max_speed_rad_s']:.3g}",
            f"{method['worst_limit_violation_rad']:.2g}",
            f"{method['joint_frames_at_limit_percent']:.3g}",
            " / ".join(f"{method['tip_direction_error_deg'][finger]:.1f}" for finger in FINGERS),
        )
        for method in report["methods"]
    ]
    header = ("method", "mean second difference mrad", "max step rad/frame", "max speed rad/s")
    header += ("worst limit violation rad", "joint-frames at a limit %", "tip direction error T / I / M / R, deg")
    lines += [*table(header, rows), ""]
    # The one place of the definitions is the README.
    definitions = (HERE / "README.md").read_text().partition("## Definitions\n")[2].partition("\n## ")[0]
    return "\n".join([*lines, "## Definitions", definitions.rstrip()]) + "\n"


def plain(value: float | None) -> str:
    return "-" if value is None else f"{value:.{0 if value >= 100 else 1}f}"


def table(header: tuple, rows: list[tuple]) -> list[str]:
    return [f"| {' | '.join(row)} |" for row in (header, ("---",) * len(header), *rows)]


def write_csv(path: Path, found: list[dict]) -> None:
    rows = [dict(flat(method)) for method in found]
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)


def flat(value: dict, prefix: str = ""):
    for key, item in value.items():
        if isinstance(item, dict):
            yield from flat(item, f"{prefix}{key}.")
        elif not isinstance(item, list):
            yield prefix + key, item


if __name__ == "__main__":
    main()
