"""MLflow: parameters, metrics and files of a run, in a local store or on a tracking server."""

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
from gsx.core.files import csv_text, write_json
from gsx.core.options import flattened
from gsx.core.packages import require
from gsx.core.plugins import hookimpl
from gsx.core.ranges import Seconds
from gsx.core.training.run import Run
from gsx.engine.machine import device_name
from gsx.trackers.figures import PictureCount, evaluation_figures, kept_state, line_figures, pictures, zoom_table

logger = logging.getLogger(__name__)

STATE = "mlflow.json"
"""File in the run folder with the store and MLflow's id of the run."""
SQLITE = "sqlite:///"
PACKAGES = ("mlflow", "sqlalchemy", "alembic")
MOST_PARAMETERS, MOST_METRICS = 100, 1000
"""MLflow's limits of one request."""
LONGEST_VALUE, LONGEST_KEY = 500, 250
"""Characters of a parameter that all server versions accept."""
DEFAULTS = {
    "MLFLOW_CONFIGURE_LOGGING": "false",  # hides lines about tables and migrations, not warnings
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",  # standard output is for the report's path
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "2",  # 7 would delay training by minutes when a server is down
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "10",  # seconds, of 120
}
"""Environment variables of MLflow, unless the user has set them."""
SECRET = re.compile(
    "pass(?!file)|pwd|token|secret|(api|access)_?key|credential|signature|^(key|auth|sig)$", re.IGNORECASE
)
"""Names of secrets in URIs."""


@dataclass(frozen=True, kw_only=True)
class MLflowOptions:
    """Options of the tracker; values in conf/tracker/mlflow.yaml."""

    name: str
    uri: str
    """MLflow's tracking URI; empty: `mlflow.db` in the output folder."""
    experiment: str
    """Name of the experiment; empty: the scene's name."""
    seconds: Seconds
    """Least time between requests during training, s."""
    pictures: PictureCount = 0
    """The default is for runs older than this option."""

    def __post_init__(self) -> None:
        if holds_secret(self.uri):  # it would be in config.yaml, report and logs
            raise ValueError(
                "tracker.mlflow.uri holds a password or token. Remove it: set MLFLOW_TRACKING_USERNAME and "
                "MLFLOW_TRACKING_PASSWORD, or MLFLOW_TRACKING_TOKEN, or for a database a variable such as PGPASSWORD"
            )


def holds_secret(uri: str) -> bool:
    """Returns whether a URI has a password or token; on web servers a user's name may be a token."""
    try:
        parts = urlsplit(uri)
    except ValueError:
        return False
    user, at, _ = parts.netloc.rpartition("@")
    pairs = parse_qsl(parts.query, keep_blank_values=True)
    named = any(SECRET.search(name) or re.search("(pwd|password)=", value, re.IGNORECASE) for name, value in pairs)
    return named or (bool(at) and (":" in user or parts.scheme in ("http", "https")))


class MLflow:
    """Tracker that records a run in MLflow.

    Raises:
        ConfigError: a package is not installed, or MLflow cannot use the URI.
    """

    def __init__(self, options: MLflowOptions) -> None:
        os.environ["MLFLOW_DISABLE_TELEMETRY"] = "true"  # no usage reports over the network
        for name, value in DEFAULTS.items():
            os.environ.setdefault(name, value)
        require("tracker mlflow", PACKAGES, "gsx[mlflow]")
        self.options = options
        self.client: Any = checked_client(options.uri) if options.uri else None
        self.run_id = ""
        self.sent_step, self.sent_at = 0, 0.0

    @hookimpl
    def gsx_run_started(self, run: Run) -> None:
        """Creates MLflow's run, or resumes the one of this run folder."""
        state = kept_state(run.folder / STATE)
        uri = self.options.uri or state.get("uri") or default_store(run)
        self.client = self.client or client_of(uri)
        if state.get("uri") == uri:
            self.run_id = state["run"]
            self.client.update_run(self.run_id, status="RUNNING")
            points = self.client.get_metric_history(self.run_id, "loss")
            self.sent_step = max((point.step for point in points), default=0)  # MLflow keeps duplicates
        else:
            self.create(run, uri)
        self.send(run)
        logger.info("tracker mlflow: run %s at %s", self.run_id, uri)

    def create(self, run: Run, uri: str) -> None:
        """Creates MLflow's run with its parameters."""
        experiment = experiment_id(self.client, uri, self.options.experiment or run.scene.name)
        tags = {"gsx.folder": str(run.folder.resolve()), "gsx.device": device_name(run.device)}
        self.run_id = self.client.create_run(experiment, tags=tags, run_name=run.folder.name).info.run_id
        write_json(run.folder / STATE, {"uri": uri, "run": self.run_id})
        for part in chunks(parameters(run.config), MOST_PARAMETERS):
            self.client.log_batch(self.run_id, params=part)

    @hookimpl
    def gsx_step_finished(self, run: Run) -> None:
        """Sends new lines, at most every `seconds`."""
        if time.monotonic() - self.sent_at >= self.options.seconds:
            self.send(run)

    @hookimpl
    def gsx_training_finished(self, run: Run) -> None:
        """Sends the rest, and marks an interrupted run as killed."""
        self.send(run)
        if not run.complete:
            self.client.set_terminated(self.run_id, "KILLED")

    @hookimpl
    def gsx_evaluated(self, run: Run, evaluation: dict[str, Any]) -> None:
        """Sends metrics, zoom table and pictures."""
        self.log(metrics(evaluation_figures(evaluation), evaluation["step"]))
        if table := zoom_table(evaluation):
            self.client.log_text(self.run_id, csv_text([*table[0]], table), "zoom.csv")
        for path in pictures(run.folder / "renders", self.options.pictures).values():
            self.client.log_artifact(self.run_id, str(path), "pictures")

    @hookimpl
    def gsx_run_finished(self, run: Run) -> None:
        """Sends files, and marks the run as finished."""
        for name in ("config.yaml", "evaluation.json", "report.html"):
            self.client.log_artifact(self.run_id, str(run.folder / name))
        self.client.set_terminated(self.run_id, "FINISHED")

    @hookimpl
    def gsx_run_failed(self, run: Run, reason: str) -> None:
        """Sends the rest, and marks the run as failed, or as killed after Ctrl-C."""
        self.send(run)
        self.client.set_tag(self.run_id, "gsx.reason", reason[:LONGEST_VALUE])
        self.client.set_terminated(self.run_id, "KILLED" if reason.startswith("KeyboardInterrupt") else "FAILED")

    def send(self, run: Run) -> None:
        """Sends the lines of metrics.jsonl after the last sent step."""
        lines = [line for line in run.progress.curves if line["step"] > self.sent_step]
        self.log([metric for line in lines for metric in metrics(line_figures(line), int(line["step"]))])
        self.sent_step = max([self.sent_step, *(int(line["step"]) for line in lines)])
        self.sent_at = time.monotonic()

    def log(self, points: Sequence[Any]) -> None:
        """Sends metrics."""
        for part in chunks(points, MOST_METRICS):
            self.client.log_batch(self.run_id, metrics=part)


def checked_client(uri: str) -> Any:
    """Returns a client for the user's URI, without a request to a server; ConfigError: MLflow cannot use it."""
    try:
        return client_of(uri)
    except Exception as error:  # of MLflow, SQLAlchemy or the system
        remedy = "give sqlite:///FILE, http://HOST:PORT, or nothing for mlflow.db in the output folder"
        raise ConfigError(f"MLflow cannot use tracker.mlflow.uri={uri} ({first_line(error)}): {remedy}") from error


def client_of(uri: str) -> Any:
    """Returns MLflow's client; a lock serialises the creation of a database's tables."""
    from mlflow import MlflowClient

    if not uri.startswith(SQLITE):
        return MlflowClient(uri)
    folder = folder_of(uri)
    folder.mkdir(parents=True, exist_ok=True)
    with FileLock(folder / ".mlflow.lock"):
        client = MlflowClient(uri)
    quoted = Path(uri.removeprefix(SQLITE)).parent
    if quoted != folder:  # MLflow also creates this folder, and leaves it empty
        with suppress(OSError):
            quoted.rmdir()
    return client


def folder_of(uri: str) -> Path:
    """Returns the folder of a URI's database."""
    return Path(unquote(uri.removeprefix(SQLITE))).parent


def default_store(run: Run) -> str:
    """Returns the URI of a database in the output folder, with ? and % escaped."""
    file = str(Path(run.config["output"]).resolve() / "mlflow.db")
    return SQLITE + file.replace("%", "%25").replace("?", "%3F")


def experiment_id(client: Any, uri: str, name: str) -> str:
    """Returns the id of an experiment; creates it if needed, with its files in the database's folder."""
    from mlflow.exceptions import MlflowException

    local = uri.startswith(SQLITE)  # MLflow's default is the current folder
    files = (folder_of(uri).resolve() / "mlflow_files" / name).as_uri() if local else None
    try:
        return str(client.create_experiment(name, artifact_location=files))
    except MlflowException as error:  # another run may create it at the same time
        if error.error_code != "RESOURCE_ALREADY_EXISTS":
            raise
        return str(client.get_experiment_by_name(name).experiment_id)


def parameters(config: dict[str, Any]) -> list[Any]:
    """Converts the configuration to MLflow's parameters, without trackers, whose URIs may hold passwords."""
    from mlflow.entities import Param

    values = flattened({key: value for key, value in config.items() if key != "tracker"})
    named = {re.sub(r"[^\w./ -]", "_", key)[:LONGEST_KEY]: str(value)[:LONGEST_VALUE] for key, value in values.items()}
    return [Param(key, value) for key, value in named.items()]


def metrics(figures: dict[str, float], step: int) -> list[Any]:
    """Converts numbers of a step to MLflow's metrics, with the current time."""
    from mlflow.entities import Metric

    now = int(time.time() * 1000)
    return [Metric(name, value, now, step) for name, value in figures.items()]


def chunks(items: Sequence[Any], size: int) -> Iterator[Sequence[Any]]:
    """Yields the items in lists of at most `size`."""
    return (items[begin : begin + size] for begin in range(0, len(items), size))
