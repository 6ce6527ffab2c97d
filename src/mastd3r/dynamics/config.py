"""Options of the dynamic mask (III-A). Natural logarithms throughout; pixels are those of half the working size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class DynamicsConfig:
    """How P(moving) is found. Each evidence term can be switched off for an ablation."""

    variant: Literal["ours", "paper", "none"] = "ours"  # paper: eq. (1)-(4) as printed; none: nothing moves
    base_rate: float = 0.1  # P(moving) where nothing is known
    use_depth: bool = True  # (a) the frame's own depth against the map's prediction
    use_motion: bool = True  # (b) flow against the rigid flow of pose and depth
    use_semantic: bool = True  # (c) P(movable) of the frame
    use_time: bool = True  # (d) the last belief, carried along the flow
    use_regions: bool = True  # joint smoothing of the evidence inside image edges
    memory: float = 0.85  # share of the carried log-odds that is kept from one frame to the next
    evidence_gain: float = 0.6  # weight of one frame's log ratio; frames are not independent of each other
    max_log_odds: float = 6.0  # clip of the accumulated evidence
    semantic_gain: float = 0.8  # weight of the map's log-odds
    semantic_floor: float = 0.02  # maps are never believed beyond floor and 1 - floor
    flow_noise_px: float = 0.25  # 1 sigma of the flow where the image has texture
    texture_noise: float = 4.0  # grey levels of noise that a texture has to beat
    motion_spread_px: float = 4.0  # 1 sigma of what a moving thing adds to the flow
    still_share: float = 0.3  # share of a moving thing's pixels that show no motion against the background
    outlier_share: float = 0.03  # share of static pixels whose flow is simply wrong
    gap_motion_px: float = 6.0  # camera motion wanted between the frame and the past frame it is compared with
    max_gap: int = 8  # frames
    depth_noise_ratio: float = 0.03  # noise of the frame's own depth, as a share of it
    region_px: int = 10  # radius of the joint smoothing
    region_contrast: float = 8.0  # grey levels that count as an edge for it

    tau_variance: float = 0.01  # eq. (1) tau_var: local variance of log depth
    tau_sigma: float = 2.5  # eq. (1) k
    window_px: int = 9  # eq. (1) window of the local variance
    tau_bayes: float = 0.5  # eq. (3)
