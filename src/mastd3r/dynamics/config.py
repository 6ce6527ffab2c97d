"""Options of the dynamic mask (III-A), one dataclass an evidence term.

Natural logarithms throughout; pixels are those of half the working size; grey levels are 0 … 255.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

from ..registry import DYNAMICS, NotNegative, OneOrMore, Positive, Range, Share

VariantKind = Annotated[str, DYNAMICS]


@dataclass(frozen=True)
class MotionConfig:
    """(b) Flow and grey values against the rigid scene of pose and depth."""

    enabled: bool = True  # False: neither flow nor grey values are evidence
    flow_noise_px: Positive = 0.25  # 1 sigma of the flow where the image has texture
    texture_noise: Positive = 4.0  # grey levels of noise that a texture has to beat
    spread_px: Positive = 4.0  # 1 sigma of what a moving thing adds to the flow
    doubts_unmatched: bool = True  # evidence weakens with the share of the static scene that finds no match
    wrong_where_failed: NotNegative = (
        0.5  # share of wrong flow among what was found / square of the share where it failed
    )
    round_trip_px: Positive = 1.5  # forward-backward error at which the flow's confidence is exp(-1/2)
    pose_sigma_deg: NotNegative = 0.3  # 1 sigma of the pose error that the motion test may take out
    noise_inflation: bool = True  # evidence weakens where the static majority fits worse than pose and depths claim
    noise_tolerance: NotNegative = 1.0  # times that the majority's squared misfit may exceed what is claimed


@dataclass(frozen=True)
class PhotometricConfig:
    """(b) The grey values' part of it."""

    noise: Positive = 5.0  # grey levels, 1 sigma of an aligned static pixel
    shift_px: NotNegative = 0.4  # misalignment that a static pixel may show
    gain: NotNegative = 0.3  # weight of grey values that fit the rigid scene better than the flow
    unexplained_gain: NotNegative = 1.5  # weight of grey values that neither explains


@dataclass(frozen=True)
class DepthConfig:
    """(a) The frame's own depth against the map's prediction."""

    enabled: bool = True
    noise_ratio: Positive = 0.03  # noise of the frame's own depth, as a share of it


@dataclass(frozen=True)
class SupportConfig:
    """Smoothing pass: a near depth that nothing holds is the mark of something that moves."""

    enabled: bool = True
    floating_gain: NotNegative = 2.0  # weight of a depth that nothing holds


@dataclass(frozen=True)
class SemanticConfig:
    """(c) P(movable) of the frame, P(D|S) of eq. (2)."""

    enabled: bool = True
    gain: NotNegative = 0.8  # weight of the map's log-odds
    evidence_share: Share = 0.3  # weight of our evidence where there is a map: it repeats from frame to frame
    floor: Annotated[float, Range(0, 0.49, above=True)] = 0.02  # maps are never believed beyond floor and 1 - floor
    missed: Annotated[float, Range(0, 0.5)] = (
        0.25  # nor below this far from what they show: a network has no class for every thing
    )
    reach_ratio: Share = 0.05  # share of the image's width that counts as near
    shows_all: bool = True  # False: it shows some of what can move (people), and where it shows nothing it says nothing
    most_partial: Annotated[float, Range(0.5, 0.99)] = 0.8  # such a map is never believed beyond this

    def outlines(self, semantic: object) -> bool:
        """Whether there is a map, and one that says where all that can move ends."""
        return semantic is not None and self.enabled and self.shows_all

    def share_beside(self, semantic: object) -> float:
        """Weight of our evidence beside a map, or beside none."""
        return self.evidence_share if self.outlines(semantic) else 1.0


@dataclass(frozen=True)
class TemporalConfig:
    """(d) Log-odds carried along the flow, and which frames are compared."""

    enabled: bool = True  # False: nothing is carried from frame to frame
    memory: Share = 0.85  # share of the carried log-odds that is kept from one frame to the next
    carry_mismatch: Positive = 10.0  # normalised grey mismatch from which the carried log-odds fade
    filter_gaps: tuple[OneOrMore, ...] = (1, 4)  # frames back that the frame is compared with while tracking
    smoother_gaps: tuple[OneOrMore, ...] = (1, 4)  # back and forth, in the smoothing pass; the last is its delay
    backward: bool = True  # smoothing pass: frames after this one are evidence too


@dataclass(frozen=True)
class AppearanceConfig:
    """(e) What moved in this video looks like, learned online."""

    enabled: bool = True
    share: NotNegative = 0.5  # weight of the classifier's log-odds
    max_log_odds: Positive = 4.0  # its log-odds are bounded by this
    memory: Share = 0.99  # share of what it knows that is kept from one frame to the next


@dataclass(frozen=True)
class RefinementConfig:
    """Edge-aware refinement: log-odds as whole objects at full size."""

    enabled: bool = True  # False: the half-size log-odds are only enlarged
    region_px: Positive = 20.0  # reach of the pooling where there is no edge
    region_contrast: Positive = 15.0  # grey levels that are as far as region_px
    semantic_contrast: NotNegative = 60.0  # grey levels that a step of the semantic map from 0 to 1 is worth
    chroma_gain: NotNegative = 1.5  # a step of colour against one of grey
    edge_px: Annotated[int, Range(1, 512)] = (
        8  # radius of the guided filter that brings masks to the full image's edges, at 512 x 384 working pixels
    )
    edge_contrast: Positive = 20.0  # grey levels that it takes for an edge
    fine_px: Positive = 24.0  # full-size pixels, reach of the last pooling, where there is colour
    fine_contrast: Positive = 12.0  # grey levels that are as far as fine_px
    fine_contrast_semantic: Positive = 20.0  # the same once a semantic map is joined; where ``colours`` is off


@dataclass(frozen=True)
class ColoursConfig:
    """The last step of the refinement, where there is colour: outlines by the colours inside and outside of them."""

    enabled: bool = True
    rounds: Annotated[int, Range(1, 100)] = 3  # densities from the outline, the outline from densities
    gain: NotNegative = 1.2  # weight of the log ratio of densities
    gain_semantic: NotNegative = 0.5  # the same once a semantic map is joined, which knows where things end
    max_log_odds: Positive = 3.5  # it is bounded by this where it speaks for motion
    max_still_log_odds: Positive = 2.0  # and by this where it speaks against: what is missed stays in the map
    trusted_log_odds: Positive = 4.6  # and what came before by this (99 %)
    reach_ratio: Share = 0.027  # of sqrt(width * height): so far an outline may grow; not at all beside a semantic map
    margin_ratio: Share = 0.07  # of the same: so far around is what does not move looked at


@dataclass(frozen=True)
class PaperConfig:
    """Thresholds of the variant ``paper``, eq. (1)-(3)."""

    tau_variance: NotNegative = 0.01  # eq. (1) tau_var: local variance of log depth
    tau_sigma: NotNegative = 2.5  # eq. (1) k
    window_px: Annotated[int, Range(1, 255)] = 9  # eq. (1) window of the local variance, pixels of the working size
    tau_bayes: Share = 0.5  # eq. (3)


@dataclass(frozen=True)
class DynamicsConfig:
    """How P(moving) is found. Each evidence term can be switched off for an ablation."""

    variant: VariantKind = "ours"  # paper: eq. (1)-(4) as printed; none: nothing moves
    base_rate: Annotated[float, Range(0, 0.99, above=True)] = 0.1  # P(moving) where nothing is known
    evidence_gain: NotNegative = 1.0  # weight of one frame's log ratios
    max_log_odds: Positive = 6.0  # clip of the accumulated evidence
    still_share: Annotated[float, Range(0, 0.99, above=True)] = (
        0.1  # share of a moving thing's pixels that show no motion against the background
    )
    outlier_share: Annotated[float, Range(0, 0.99, above=True)] = (
        0.03  # share of static pixels whose flow or depth is simply wrong
    )
    motion: MotionConfig = field(default_factory=MotionConfig)
    photometric: PhotometricConfig = field(default_factory=PhotometricConfig)
    depth: DepthConfig = field(default_factory=DepthConfig)
    support: SupportConfig = field(default_factory=SupportConfig)
    semantic: SemanticConfig = field(default_factory=SemanticConfig)
    temporal: TemporalConfig = field(default_factory=TemporalConfig)
    appearance: AppearanceConfig = field(default_factory=AppearanceConfig)
    refinement: RefinementConfig = field(default_factory=RefinementConfig)
    colours: ColoursConfig = field(default_factory=ColoursConfig)
    paper: PaperConfig = field(default_factory=PaperConfig)

    def while_tracking(self) -> DynamicsConfig:
        """A pose needs every static point that there is: a semantic map is believed where it shows nothing.

        And it needs what moves kept out: at a fast turn, too, what finds no match is held to move.
        """
        semantic = replace(self.semantic, missed=self.semantic.floor)
        return replace(self, semantic=semantic, motion=replace(self.motion, doubts_unmatched=False))


OLD_NAMES = {  # of one version ago -> section.name now
    "use_motion": "motion.enabled",
    "flow_noise_px": "motion.flow_noise_px",
    "texture_noise": "motion.texture_noise",
    "motion_spread_px": "motion.spread_px",
    "round_trip_px": "motion.round_trip_px",
    "pose_doubt_deg": "motion.pose_sigma_deg",
    "use_doubt": "motion.noise_inflation",
    "doubt_tolerance": "motion.noise_tolerance",
    "photo_noise": "photometric.noise",
    "photo_shift_px": "photometric.shift_px",
    "photo_gain": "photometric.gain",
    "clash_gain": "photometric.unexplained_gain",
    "use_depth": "depth.enabled",
    "depth_noise_ratio": "depth.noise_ratio",
    "use_support": "support.enabled",
    "floating_gain": "support.floating_gain",
    "use_semantic": "semantic.enabled",
    "semantic_gain": "semantic.gain",
    "semantic_share": "semantic.evidence_share",
    "semantic_floor": "semantic.floor",
    "semantic_missed": "semantic.missed",
    "semantic_reach": "semantic.reach_ratio",
    "use_time": "temporal.enabled",
    "memory": "temporal.memory",
    "carry_mismatch": "temporal.carry_mismatch",
    "gaps": "temporal.filter_gaps",
    "second_gaps": "temporal.smoother_gaps",
    "use_future": "temporal.backward",
    "use_head": "appearance.enabled",
    "head_share": "appearance.share",
    "head_limit": "appearance.max_log_odds",
    "head_memory": "appearance.memory",
    "use_regions": "refinement.enabled",
    "region_px": "refinement.region_px",
    "region_contrast": "refinement.region_contrast",
    "semantic_contrast": "refinement.semantic_contrast",
    "chroma_gain": "refinement.chroma_gain",
    "edge_px": "refinement.edge_px",
    "edge_contrast": "refinement.edge_contrast",
    "fine_px": "refinement.fine_px",
    "fine_contrast": "refinement.fine_contrast",
    "map_contrast": "refinement.fine_contrast_semantic",
    "tau_variance": "paper.tau_variance",
    "tau_sigma": "paper.tau_sigma",
    "window_px": "paper.window_px",
    "tau_bayes": "paper.tau_bayes",
}
