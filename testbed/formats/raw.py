"""What a reader found in its files, before anything is checked or aligned; SI units and radians, n and b as everywhere."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from testbed.data.records import Array, BaroSamples, GnssFixes, ImuSamples, InitialState, MagSamples, Phase, Trajectory


@dataclass
class Raw:
    """Sample tables with the files' specifications; one reader for each format makes one."""

    name: str = ""
    imu: ImuSamples | None = None
    t_start: float = 0.0
    """Where the interval of the first IMU sample begins."""
    gnss: GnssFixes | None = None
    gnss_position_only: bool = False
    """Whether the receiver states no velocity: ``v_n`` is then zero until it is derived."""
    gnss_level_velocity: bool = False
    """Whether it states speed and course and no vertical velocity."""
    mag: MagSamples | None = None
    baro: BaroSamples | None = None
    others: dict[str, Any] = field(default_factory=dict)
    """Samples of further sensors by their kind."""
    motion: tuple[Array, ...] | None = None
    """The reference: t, lat, lon, h, v_n, q_nb."""
    reference: Trajectory | None = None
    """The reference with its own ``f_b`` and ``w_ib_b``, where the files have them."""
    own_times: bool = False
    """Whether the reference is to be scored at its own rows only, however dense they are."""
    phases: tuple[Phase, ...] = ()
    stated: set[str] = field(default_factory=set)
    """Sensors whose figures the files state."""
    field_known: bool = False
    """Whether the magnetometer's specification states the local field; else it is measured at the start."""
    initial: InitialState | None = None
    """The whole initial state, where the files state it."""
    attitude: tuple[Array, Array] | None = None
    """Roll, pitch, yaw at ``t_start`` and their sigmas (3,), rad, where the files state only these."""
    utc: float | None = None
    """Unix time of ``t`` = 0, s, where the files tell the date."""
    gyro_bias: Array | None = None
    """(3,) rad/s: signed bias that was measured beforehand."""
    places: dict[str, str] = field(default_factory=dict)
    """Part -> how messages name it: its file."""
    notes: list[str] = field(default_factory=list)
    """What the reader left out or assumed, in sentences."""

    def place(self, part: str) -> str:
        """How a message names a part."""
        return self.places.get(part, part)
