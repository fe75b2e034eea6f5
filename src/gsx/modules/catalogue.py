"""The built-in training modules, in the order in which a run has them."""

from collections.abc import Mapping

from gsx.core.training.module import TrainingModule
from gsx.modules.appearance import Appearance, AppearanceOptions
from gsx.modules.blur import Blur, BlurOptions
from gsx.modules.coarse_to_fine import CoarseToFine, CoarseToFineOptions
from gsx.modules.deadline import Deadline, DeadlineOptions
from gsx.modules.depth import Depth, DepthOptions
from gsx.modules.distractors import DistractorOptions, Distractors
from gsx.modules.exposure import Exposure, ExposureOptions
from gsx.modules.plateau import Plateau, PlateauOptions
from gsx.modules.poses import PoseOptions, Poses
from gsx.modules.supersampling import Supersampling, SupersamplingOptions
from gsx.modules.trial import Trial, TrialOptions

MODULES: Mapping[str, tuple[type[TrainingModule], type]] = {
    "coarse_to_fine": (CoarseToFine, CoarseToFineOptions),
    "supersampling": (Supersampling, SupersamplingOptions),
    "plateau": (Plateau, PlateauOptions),
    "deadline": (Deadline, DeadlineOptions),
    "trial": (Trial, TrialOptions),
    "poses": (Poses, PoseOptions),
    "exposure": (Exposure, ExposureOptions),
    "appearance": (Appearance, AppearanceOptions),
    "blur": (Blur, BlurOptions),
    "distractors": (Distractors, DistractorOptions),
    "depth": (Depth, DepthOptions),
}
"""Module and options by name."""
