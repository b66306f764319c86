"""`my-policy`: noise that follows the innovations (Sage & Husa, 1969), and `eskf` with it. A start to change."""

from dataclasses import dataclass

import numpy as np

from estimators.methods.eskf import Eskf
from estimators.policies import Policy, add_policy


def judge(memory, residual, s, r, h, p):  # compiled; s = H P H' + R; r (m,) is the stated noise and may be set
    for i in range(residual.shape[0]):
        seen = residual[i] ** 2 - (s[i, i] - r[i])
        memory[1 + i] += memory[0] * (seen / r[i] - memory[1 + i])
        r[i] *= max(memory[1 + i], 0.01)
    return 1.0  # 0 rejects the measurement, more than 1 multiplies P


add_policy(Policy("my-policy", judge, lambda rows, share=0.02: np.array([share] + rows * [1.0])))


@dataclass(frozen=True)
class MyPolicy(Eskf):
    name = "my-policy"
    policy: object = "my-policy"  # or { my-policy = { share = 0.05 } }
    parameter_space = {"policy.my-policy.share": (1e-3, 0.3, "log")}  # what `testbed tune` may search
