"""A small training of `ahrs-lstm` in a process of its own, to be killed: OUT [--resume]."""

from __future__ import annotations

import sys

import small_training as case

if __name__ == "__main__":
    flights = [case.Flight(seed) for seed in range(3)]
    case.trained(
        flights, sys.argv[1], resume="--resume" in sys.argv, tell=lambda text: print(text, flush=True), epochs=6
    )
