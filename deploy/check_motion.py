#!/usr/bin/env python3
"""Says whether the hand moved, from what `operator watch --json` prints.

    operator watch --json --duration 5 | deploy/check_motion.py moves [--mode engaged]
    operator watch --json --duration 5 | deploy/check_motion.py still [--mode holding]

`moves`: at least three joints covered more than 0.1 rad. `still`: no joint covered more than 0.02 rad. With --mode the
last state must be of that mode. Exit code: 0, so it is; 1, it is not, or there is no state to judge by.
"""

import argparse
import json
import sys

MOVED = 0.1  # rad; the tour bends every finger further
MOVED_JOINTS = 3
STILL = 0.02  # rad; the hand settles within this once its command stands still


def fail(text):
    print(f"error: {text}", file=sys.stderr)
    sys.exit(1)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("expected", choices=("moves", "still"))
    parser.add_argument("--mode")
    arguments = parser.parse_args()

    # A line without joints is of a robot whose first state has not arrived yet.
    states = [state for state in map(json.loads, sys.stdin) if "q" in state]
    if len(states) < 10:
        fail(f"{len(states)} states are too few to judge by: is the robot running?")
    ranges = [max(joint) - min(joint) for joint in zip(*(state["q"] for state in states), strict=True)]
    mode = states[-1]["mode"]
    moved = sum(covered > MOVED for covered in ranges)
    print(f"{len(states)} states, mode {mode}, {moved} joints moved, widest range {max(ranges):.3f} rad")

    if arguments.mode and mode.lower() != arguments.mode.lower():
        fail(f"the mode is {mode}, not {arguments.mode}")
    if arguments.expected == "moves" and moved < MOVED_JOINTS:
        fail(f"only {moved} joints covered more than {MOVED} rad")
    if arguments.expected == "still" and max(ranges) > STILL:
        fail(f"a joint covered {max(ranges):.3f} rad, more than {STILL} rad")


if __name__ == "__main__":
    main()
