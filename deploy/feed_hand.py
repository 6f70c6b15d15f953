#!/usr/bin/env python3
"""Feeds a hand that opens and closes to `operator run --source zenoh`: an example to start from.

    pip install eclipse-zenoh==1.10.2 && deploy/feed_hand.py [SECONDS [ENDPOINT]]
"""

import json
import math
import sys
import time

import zenoh

seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 30.0
endpoint = sys.argv[2] if len(sys.argv) > 2 else "tcp/127.0.0.1:7448"

config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", json.dumps([endpoint]))

with zenoh.open(config) as session:
    hand = session.declare_publisher("allegro/v1/allegro/in/hand")
    start = time.monotonic()
    while (t := time.monotonic() - start) < seconds:
        bend = 0.5 - 0.5 * math.cos(math.pi * t)  # 0 open, 1 closed; a second each way
        thumb = [1.6, 0.6 * bend, 0.4 * bend, 0.0]
        finger = [0.0, 0.9 * bend, 1.0 * bend, 0.6 * bend]  # abduction, then MCP, PIP and DIP flexion, rad
        hand.put(json.dumps({"t": t, "q": thumb + 4 * finger}))  # or "keypoints": 21 x [x, y, z], m
        time.sleep(0.01)
