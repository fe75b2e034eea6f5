"""MLflow: parameters, metrics and files of a run in a store beside the runs, or on a tracking server."""

import logging
import os
import re
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, unquote, urlsplit

from filelock import FileLock

from gsx.core.errors import ConfigError, first_line
from gsx.core.files import read_json, write_json
from gsx.core.options import flattened
from gsx.core.packages import require
from gsx.core.plugins import hookimpl
from gsx.core.ranges import Seconds
from gsx.core.training.run import Run
from gsx.engine.machine import device_name
from gsx.trackers.figures import evaluation_figures, line_figures

logger = logging.getLogger(__name__)

KEPT = "mlflow.json"
"""File in the run folder: the store and MLflow's id of the run."""
SQLITE = "sqlite:///"
PACKAGES = ("mlflow", "sqlalchemy", "alembic")
PARAMETERS_AT_ONCE, METRICS_AT_ONCE = 100, 1000
"""Most that MLflow takes in one request."""
LONGEST_VALUE, LONGEST_KEY = 500, 250
"""Characters of a parameter that every version of a server takes."""
DEFAULTS = {
    "MLFLOW_CONFIGURE_LOGGING": "false",  # its own lines about tables and migrations; warnings are still shown
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",  # standard output is for the report's path
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "2",  # 7 would hold training up for minutes when a server is down
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "10",  # seconds, of 120
}
"""What MLflow is told where the user's environment says nothing else."""


@dataclass(frozen=True, kw_only=True)
class MLflowOptions:
    """Options of the tracker; values in conf/tracker/mlflow.yaml."""

    name: str
    uri: str
    """MLflow's tracking URI; empty: `mlflow.db` in the output folder."""
    experiment: str
    """Experiment that runs are listed under; empty: the scene's name."""
    seconds: Seconds
    """Least time between requests during training; what is due meanwhile goes together."""

    def __post_init__(self) -> None:
        if holds_secret(self.uri):  # config.yaml, the report and logs would tell it
            raise ValueError(
                "tracker.mlflow.uri holds a password or token; leave it out: for a server set MLFLOW_TRACKING_USERNAME "
                "and MLFLOW_TRACKING_PASSWORD, or MLFLOW_TRACKING_TOKEN, for a database use its own means, such as "
                "PGPASSWORD"
            )


SECRET = re.compile(
    "pass(?!file)|pwd|token|secret|(api|access)_?key|credential|signature|^(key|auth|sig)$", re.IGNORECASE
)
"""What names of secrets have in them."""


def holds_secret(uri: str) -> bool:
    """Whether an address tells more of a user than a name for a database, or has a parameter that is named as secrets
    are. What servers take for a name may be a token."""
    try:
        parts = urlsplit(uri)
    except ValueError:
        return False
    user, at, _ = parts.netloc.rpartition("@")
    given = parse_qsl(parts.query, keep_blank_values=True)
    named = any(SECRET.search(name) or re.search("(pwd|password)=", value, re.IGNORECASE) for name, value in given)
    return named or (bool(at) and (":" in user or parts.scheme in ("http", "https")))


class MLflow:
    """Listener: keeps a run of MLflow.

    Raises:
        ConfigError: a package is not installed, or MLflow cannot use the URI.
    """

    def __init__(self, options: MLflowOptions) -> None:
        keep_quiet()
        require("tracker mlflow", PACKAGES, "gsx[mlflow]")
        self.options = options
        self.client: Any = checked_client(options.uri) if options.uri else None
        self.run_id = ""
        self.sent, self.told = 0, 0.0

    @hookimpl
    def gsx_run_started(self, run: Run) -> None:
        """Begin a run of MLflow's, or go on with the one that this run had before."""
        kept = read_json(run.folder / KEPT) if (run.folder / KEPT).is_file() else {}
        uri = self.options.uri or kept.get("uri") or own_store(run)
        self.client = self.client or client_of(uri)
        if kept.get("uri") == uri:
            self.go_on(kept["run"])
        else:
            self.begin(run, uri)
        self.send(run)
        logger.info("tracker mlflow: run %s at %s", self.run_id, uri)

    def go_on(self, run_id: str) -> None:
        """Continue after the last step that MLflow knows: it cannot forget points, and steps repeated are the same."""
        self.run_id = run_id
        self.client.update_run(run_id, status="RUNNING")
        self.sent = max((point.step for point in self.client.get_metric_history(run_id, "loss")), default=0)

    def begin(self, run: Run, uri: str) -> None:
        """A new run, with its parameters."""
        experiment = experiment_id(self.client, uri, self.options.experiment or run.scene.name)
        tags = {"gsx.folder": str(run.folder.resolve()), "gsx.device": device_name(run.device)}
        self.run_id = self.client.create_run(experiment, tags=tags, run_name=run.folder.name).info.run_id
        write_json(run.folder / KEPT, {"uri": uri, "run": self.run_id})
        for some in portions(parameters(run.config), PARAMETERS_AT_ONCE):
            self.client.log_batch(self.run_id, params=some)

    @hookimpl
    def gsx_step_finished(self, run: Run) -> None:
        """Send what metrics.jsonl has got, when it is time."""
        if time.monotonic() - self.told >= self.options.seconds:
            self.send(run)

    @hookimpl
    def gsx_training_finished(self, run: Run) -> None:
        """Send the rest; a run that was interrupted is marked so."""
        self.send(run)
        if not run.complete:
            self.client.set_terminated(self.run_id, "KILLED")

    @hookimpl
    def gsx_evaluated(self, evaluation: dict[str, Any]) -> None:
        """Send the figures."""
        self.log(metrics(evaluation_figures(evaluation), evaluation["step"]))

    @hookimpl
    def gsx_run_finished(self, run: Run) -> None:
        """Send files, and mark the run as finished."""
        for name in ("config.yaml", "evaluation.json", "report.html"):
            self.client.log_artifact(self.run_id, str(run.folder / name))
        self.client.set_terminated(self.run_id, "FINISHED")

    @hookimpl
    def gsx_run_failed(self, run: Run, reason: str) -> None:
        """Send the rest, and mark the run as failed, or as killed when it was Ctrl-C."""
        self.send(run)
        self.client.set_tag(self.run_id, "gsx.reason", reason[:LONGEST_VALUE])
        self.client.set_terminated(self.run_id, "KILLED" if reason.startswith("KeyboardInterrupt") else "FAILED")

    def send(self, run: Run) -> None:
        """Send the lines of metrics.jsonl that have not been sent."""
        lines = [line for line in run.curves if line["step"] > self.sent]
        self.log([metric for line in lines for metric in metrics(line_figures(line), int(line["step"]))])
        self.sent = max([self.sent, *(int(line["step"]) for line in lines)])
        self.told = time.monotonic()

    def log(self, points: Sequence[Any]) -> None:
        """Send metrics."""
        for some in portions(points, METRICS_AT_ONCE):
            self.client.log_batch(self.run_id, metrics=some)


def keep_quiet() -> None:
    """Set what MLflow reads from the environment of this process when it is imported."""
    os.environ["MLFLOW_DISABLE_TELEMETRY"] = "true"  # it would report its use over the network
    for name, value in DEFAULTS.items():
        os.environ.setdefault(name, value)


def checked_client(uri: str) -> Any:
    """A client for a URI of the user's; a server is not asked yet.

    Raises:
        ConfigError: MLflow cannot use it.
    """
    try:
        return client_of(uri)
    except Exception as error:  # MLflow's own, SQLAlchemy's, the system's
        remedy = "give sqlite:///FILE, http://HOST:PORT, or nothing for mlflow.db in the output folder"
        raise ConfigError(f"MLflow cannot use tracker.mlflow.uri={uri} ({first_line(error)}): {remedy}") from error


def client_of(uri: str) -> Any:
    """MLflow's client; runs that begin together make the tables of a database one after the other."""
    from mlflow import MlflowClient

    if not uri.startswith(SQLITE):
        return MlflowClient(uri)
    folder = folder_of(uri)
    folder.mkdir(parents=True, exist_ok=True)
    with FileLock(folder / ".mlflow.lock"):
        client = MlflowClient(uri)
    quoted = Path(uri.removeprefix(SQLITE)).parent
    if quoted != folder:  # MLflow makes that folder as well, and leaves it empty
        with suppress(OSError):
            quoted.rmdir()
    return client


def folder_of(uri: str) -> Path:
    """Where the database of a URI lies."""
    return Path(unquote(uri.removeprefix(SQLITE))).parent


def own_store(run: Run) -> str:
    """URI of the database in the output folder; in it ? and % have another meaning than in a path."""
    file = str(Path(run.config["output"]).resolve() / "mlflow.db")
    return SQLITE + file.replace("%", "%25").replace("?", "%3F")


def experiment_id(client: Any, uri: str, name: str) -> str:
    """The experiment's id; made if it is missing, with its files beside a database, else where a server has them."""
    from mlflow.exceptions import MlflowException

    local = uri.startswith(SQLITE)  # MLflow's own choice is the current folder
    files = (folder_of(uri).resolve() / "mlflow_files" / name).as_uri() if local else None
    try:
        return client.create_experiment(name, artifact_location=files)
    except MlflowException as error:
        if error.error_code != "RESOURCE_ALREADY_EXISTS":
            raise
        return client.get_experiment_by_name(name).experiment_id


def parameters(config: dict[str, Any]) -> list[Any]:
    """The configuration as MLflow's parameters, without that of trackers: addresses may hold passwords.

    Dotted keys, in characters and lengths that it accepts.
    """
    from mlflow.entities import Param

    told = flattened({key: value for key, value in config.items() if key != "tracker"})
    values = {re.sub(r"[^\w./ -]", "_", key)[:LONGEST_KEY]: str(value) for key, value in told.items()}
    return [Param(key, value[:LONGEST_VALUE]) for key, value in values.items()]


def metrics(figures: dict[str, float], step: int) -> list[Any]:
    """Figures of a step as MLflow's metrics, now."""
    from mlflow.entities import Metric

    now = int(time.time() * 1000)
    return [Metric(name, value, now, step) for name, value in figures.items()]


def portions(items: Sequence[Any], size: int) -> Iterator[Sequence[Any]]:
    """The items, up to `size` at a time."""
    return (items[begin : begin + size] for begin in range(0, len(items), size))
