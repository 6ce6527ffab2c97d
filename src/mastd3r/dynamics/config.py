"""Options of the dynamic mask (III-A). Natural logarithms throughout; pixels are those of half the working size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

VariantKind = Literal["ours", "paper", "none"]


@dataclass(frozen=True)
class DynamicsConfig:
    """How P(moving) is found. Each evidence term can be switched off for an ablation."""

    variant: VariantKind = "ours"  # paper: eq. (1)-(4) as printed; none: nothing moves
    base_rate: float = 0.1  # P(moving) where nothing is known
    use_depth: bool = True  # (a) the frame's own depth against the map's prediction
    use_motion: bool = True  # (b) flow and grey values against the rigid scene of pose and depth
    use_support: bool = True  # second pass: a near depth that nothing holds is the mark of something that moves
    use_semantic: bool = True  # (c) P(movable) of the frame
    use_time: bool = True  # (d) the last belief, carried along the flow
    use_head: bool = True  # (e) looks of what moved in this video, learned online
    use_future: bool = True  # second pass: frames after this one are evidence too
    use_doubt: bool = True  # evidence weakens where the static majority fits worse than pose and depths claim
    use_regions: bool = True  # pooling of the belief inside image edges
    memory: float = 0.85  # share of the carried log-odds that is kept from one frame to the next
    evidence_gain: float = 1.0  # weight of one frame's log ratios
    max_log_odds: float = 6.0  # clip of the accumulated evidence
    semantic_gain: float = 0.8  # weight of the map's log-odds
    semantic_share: float = 0.3  # weight of our evidence where there is a map: it repeats from frame to frame
    semantic_floor: float = 0.02  # maps are never believed beyond floor and 1 - floor
    semantic_missed: float = 0.25  # nor below this far from what they show: a network has no class for every thing
    semantic_reach: float = 0.05  # share of the image's width that counts as near
    gaps: tuple[int, ...] = (1, 4)  # frames back that the frame is compared with while tracking
    second_gaps: tuple[int, ...] = (1, 4, 12)  # frames back and forth, in the second pass; the last is its delay
    head_share: float = 0.5  # weight of the head's log-odds
    head_limit: float = 4.0  # its log-odds are bounded by this
    head_memory: float = 0.99  # share of what it knows that is kept from one frame to the next
    flow_noise_px: float = 0.25  # 1 sigma of the flow where the image has texture
    texture_noise: float = 4.0  # grey levels of noise that a texture has to beat
    motion_spread_px: float = 4.0  # 1 sigma of what a moving thing adds to the flow
    still_share: float = 0.1  # share of a moving thing's pixels that show no motion against the background
    outlier_share: float = 0.03  # share of static pixels whose flow is simply wrong
    round_trip_px: float = 1.5  # forward-backward error at which the flow is half believed
    pose_doubt_deg: float = 0.3  # 1 sigma of the pose error that the motion test may take out
    photo_noise: float = 5.0  # grey levels, 1 sigma of an aligned static pixel
    photo_shift_px: float = 0.4  # misalignment that a static pixel may show
    photo_gain: float = 0.3  # weight of grey values that fit the rigid scene better than the flow
    clash_gain: float = 1.5  # weight of grey values that nothing explains
    carry_mismatch: float = 10.0  # normalised grey mismatch from which the carried belief fades
    depth_noise_ratio: float = 0.03  # noise of the frame's own depth, as a share of it
    floating_gain: float = 2.0  # weight of a depth that nothing holds
    region_px: float = 20.0  # reach of the pooling where there is no edge
    region_contrast: float = 15.0  # grey levels that are as far as region_px
    semantic_contrast: float = 60.0  # grey levels that a step of the semantic map from 0 to 1 is worth
    doubt_tolerance: float = 1.0  # times that the majority's squared misfit may exceed what is claimed
    chroma_gain: float = 1.5  # a step of colour against one of grey, for outlines
    fine_px: float = 24.0  # reach of the last step at full size, where there is colour
    fine_contrast: float = 12.0  # grey levels that are as far as fine_px
    map_contrast: float = 20.0  # the same once a semantic map is joined, whose own outlines are coarse
    edge_px: int = 8  # radius of the last step, which brings masks to the image's edges
    edge_contrast: float = 20.0  # grey levels that it takes for an edge
    tau_variance: float = 0.01  # eq. (1) tau_var: local variance of log depth
    tau_sigma: float = 2.5  # eq. (1) k
    window_px: int = 9  # eq. (1) window of the local variance
    tau_bayes: float = 0.5  # eq. (3)
