"""A walker made of formulas: feet with known event times, anywhere in the world, at any time stamps."""

import dataclasses

import numpy as np

from pbl_pipeline.gait import FootTrajectories
from pbl_pipeline.gait.motion import heading_agreement, heading_from_hips

UP = np.array([0.0, 0.0, 1.0])
LEG_M = 0.9
STRIDE_S = 1.12
#: Share of the stride from initial contact to toe-off of one side.
STANCE = 0.62


@dataclasses.dataclass(frozen=True)
class Walker:
    """Foot positions relative to the pelvis as functions of time, and when they are extreme.

    A foot moves back in stance and forward in swing, each along half a cosine: foremost exactly at initial contact,
    rearmost exactly at toe-off. Stance is longer than swing, so the curve is sharper on one side of each extremum, as
    in real walking: a low-pass filter moves the extremum a little (7 ms at 6 Hz) towards the flatter side.
    """

    start_s: float = 0.3
    stride_s: float = STRIDE_S
    amplitude_m: float = 0.32
    right_delay: float = 0.5

    def events(self, duration_s: float) -> list[tuple[float, str, str]]:
        out = []
        for side, delay in (("left", 0.0), ("right", self.right_delay)):
            for k in range(-2, int(duration_s / self.stride_s) + 2):
                down = self.start_s + (k + delay) * self.stride_s
                out += [(down, side, "foot_down"), (down + STANCE * self.stride_s, side, "foot_up")]
        return sorted(e for e in out if 0 <= e[0] <= duration_s)

    def forward(self, time_s: np.ndarray, side: str) -> np.ndarray:
        """Smooth curve whose maximum is at initial contact and minimum at toe-off: two half cosines."""
        delay = 0.0 if side == "left" else self.right_delay
        phase = ((time_s - self.start_s) / self.stride_s - delay) % 1.0
        back = np.cos(np.pi * phase / STANCE)
        ahead = -np.cos(np.pi * (phase - STANCE) / (1 - STANCE))
        return self.amplitude_m * np.where(phase < STANCE, back, ahead)


def make_feet(
    time_s: np.ndarray,
    walker: Walker | None = None,
    *,
    heading_deg: float | np.ndarray = 0.0,
    speed_m_per_s: float = 1.2,
    noise_m: float = 0.0,
    scale: float = 1.0,
    seed: int = 0,
) -> FootTrajectories:
    """Trajectories of a walker (None: stands) who faces and goes along `heading_deg` in a z-up world."""
    rng = np.random.default_rng(seed)
    angle = np.radians(np.broadcast_to(heading_deg, time_s.shape))
    ahead = np.column_stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
    left = np.cross(UP, ahead)
    way = np.cumsum(ahead * speed_m_per_s * np.gradient(time_s)[:, None], axis=0)
    pelvis = way + np.array([3.0, -2.0, LEG_M])
    heel, toe = np.empty((len(time_s), 2, 3)), np.empty((len(time_s), 2, 3))
    for s, (side, sign) in enumerate((("left", 1.0), ("right", -1.0))):
        x = walker.forward(time_s, side) if walker is not None else np.zeros_like(time_s)
        heel[:, s] = pelvis + x[:, None] * ahead + sign * 0.1 * left - LEG_M * UP
        toe[:, s] = heel[:, s] + 0.18 * ahead
    # The pelvis turns with the stride.
    swing = np.radians(6.0) * np.cos(2 * np.pi * time_s / STRIDE_S)
    line = left * np.cos(swing)[:, None] + ahead * np.sin(swing)[:, None]
    hip = np.stack([pelvis + 0.09 * line, pelvis - 0.09 * line], axis=1)
    parts = [scale * (p + noise_m * rng.standard_normal(p.shape)) for p in (hip, heel, toe)]
    hip, heel, toe = parts
    forward = heading_from_hips(time_s, hip, UP)
    middle = hip.mean(axis=1)
    return FootTrajectories(
        time_s=time_s,
        heel_m=heel,
        toe_m=toe,
        pelvis_m=middle,
        forward=forward,
        up=UP,
        confidence=np.full((len(time_s), 2), np.nan),
        source="synthetic",
        heading_agreement=heading_agreement(time_s, middle, forward, UP),
    )


def errors_s(found, truth, margin_s: float, duration_s: float) -> np.ndarray:
    """Time of each found event minus the true one; fails where one is missing or too many away from the ends."""
    inside = [t for t in truth if margin_s < t[0] < duration_s - margin_s]
    out = []
    for time, side, event in inside:
        near = [t - time for t in found.times(side, event) if abs(t - time) < 0.2]
        assert len(near) == 1, (time, side, event, near)
        out.append(near[0])
    n_found = sum(margin_s < e.time_s < duration_s - margin_s for e in found.events)
    assert abs(n_found - len(inside)) <= 2  # an event at the margin may fall on either side of it
    return np.array(out)
