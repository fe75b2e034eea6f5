"""The evaluation of a run made anew, in its folder."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gsx.core.files import remove_partial
from gsx.core.plugins import Plugins
from gsx.experiments.reports.report import write_report
from gsx.experiments.run_folder.claims import claimed
from gsx.experiments.runs.evaluate import evaluate
from gsx.experiments.runs.execute import finish
from gsx.experiments.runs.open import as_trained, open_run, refuse_other, refuse_training
from gsx.experiments.runs.rasterizer_path import warm


def evaluate_again(folder: Path, plugins: Plugins, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """Writes evaluation.json, pictures, splat file and report of a run, drawn by the path that trained it.

    Raises:
        ConfigError, InputError: an override is wrong, the folder is no run, or somebody trains in it.
        CheckpointError: there is no usable checkpoint.
    """
    refuse_other(folder)
    refuse_training(folder, overrides)
    with claimed(folder):
        remove_partial(folder)
        run, settings = open_run(folder, plugins, overrides)
        run.raster = as_trained(run)
        warm(run)
        if run.complete:
            return finish(run, settings, plugins)
        evaluation = evaluate(run, settings)
        plugins.emit.gsx_evaluated(run=run, evaluation=evaluation)
        write_report(folder)
        return evaluation
