"""From a scenario to the motion of its vehicle."""

from __future__ import annotations

import numpy as np

from ultratight.ins.recorded_motion import RecordedMotion
from ultratight.ins.trajectory import RigidMotion, Segment, Trajectory
from ultratight.ins.vibration import Vibrating, Vibration
from ultratight.scenario import InvalidInput, Scenario


def motion(s: Scenario) -> RigidMotion:
    """The trajectory file's motion, or that of the profile; with the scenario's vibration.

    `InvalidInput` for a trajectory file that cannot be used.
    """
    smooth = _smooth_motion(s)
    if not s.vibration:
        return smooth
    return Vibrating(smooth, [Vibration(**v.model_dump()) for v in s.vibration])


def _smooth_motion(s: Scenario) -> RigidMotion:
    if s.trajectory is not None:
        try:
            motion = RecordedMotion.from_csv(s.trajectory)
            motion.check_covers(s.duration_s)
        except ValueError as error:
            raise InvalidInput(f"trajectory: {error}") from None
        return motion
    lat, lon, h = s.position_lla_deg_m
    return Trajectory.from_profile(
        (np.radians(lat), np.radians(lon), h),
        np.radians(s.heading_deg),
        s.speed_mps,
        [
            Segment(
                p.t0_s,
                p.t1_s,
                p.accel0_mps2,
                p.accel1_mps2,
                np.radians(p.turn_rate0_deg_s),
                np.radians(p.turn_rate1_deg_s),
            )
            for p in s.profile
        ],
        climb_rad=np.radians(s.climb_deg) if s.plane == "vertical" else None,
        duration_s=s.duration_s,
    )
