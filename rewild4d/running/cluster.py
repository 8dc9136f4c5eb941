"""Open a Dask cluster: a scheduler that runs already, or the workers that a cluster file asks for."""

import contextlib
import importlib
import importlib.util
import logging
import os
import shutil
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import resource_tracker
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from rewild4d.errors import UserError, reason, unknown_name
from rewild4d.foreign.texts import read_text, read_toml
from rewild4d.running.interrupts import block_interrupts, kept_interrupts
from rewild4d.running.parts import Records

if TYPE_CHECKING:
    from distributed import Client

PATIENCE = "10s"
"""How long a scheduler has to answer."""
LOCAL = "LocalCluster"


class ClusterFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a cluster file says, as TOML or YAML.

    Attributes:
        kind: `class` in the file: of dask-jobqueue ("SLURMCluster"), "LocalCluster", or "module:Class" of another.
        workers: runs at a time; a job of several processes has several.
        retries: how often a run is started again whose worker was lost.
        arguments: of the class.
    """

    kind: str = msgspec.field(name="class")
    workers: int = 1
    retries: int = 3
    arguments: dict[str, Any] = {}


@dataclass(frozen=True)
class Site:
    """Where to run.

    Attributes:
        records: where workers write.
        scheduler: address of one that runs already; "" for the file's.
        file: what to start; used where there is no address.
        source: the file's path, for messages.
    """

    records: Records
    scheduler: str = ""
    file: ClusterFile = ClusterFile(LOCAL)
    source: str = "--cluster"


def read_cluster_file(path: Path) -> ClusterFile:
    """Read a cluster file: TOML, or YAML where its name ends so.

    Raises:
        UserError: it cannot be read, is something else, or names a class or numbers that cannot be.
    """
    expected = "a cluster file (class, workers, arguments)"
    if path.suffix in (".yaml", ".yml"):
        found = _read_yaml(path, expected)
    else:
        found = read_toml(path, expected, ClusterFile)
    for name, least in (("workers", 1), ("retries", 0)):
        if (value := getattr(found, name)) < least:
            raise UserError(f"{path}: expected `{name}` of at least {least}, got {value}.")
    _load_class(found.kind, str(path))
    return found


def _read_yaml(path: Path, expected: str) -> ClusterFile:
    import yaml

    text = read_text(path, expected)
    try:
        return msgspec.convert(yaml.safe_load(text), type=ClusterFile)
    except (yaml.YAMLError, msgspec.ValidationError, RecursionError) as error:
        raise UserError(f"{path}: expected {expected}, but {reason(error)}.") from error


def _load_class(kind: str, source: str) -> type:
    """Return the class of a cluster."""
    module, colon, name = kind.partition(":")
    if colon:
        try:
            with kept_interrupts():
                return getattr(importlib.import_module(module), name)
        except (ImportError, AttributeError, ValueError) as error:
            raise UserError(f"{source}: expected a class at {kind}, but {reason(error)}.") from error
    if kind == LOCAL:
        return importlib.import_module("distributed").LocalCluster
    if importlib.util.find_spec("dask_jobqueue") is None:
        raise UserError(f"{source}: expected the package dask-jobqueue for {kind}, run: pip install -e '.[cluster]'.")
    with kept_interrupts():
        queues = importlib.import_module("dask_jobqueue")
    known = [name for name in dir(queues) if name.endswith("Cluster") and name != "JobQueueCluster"]
    if kind not in known:
        raise unknown_name("class of a cluster", kind, [LOCAL, *known])
    return getattr(queues, kind)


def check_site(site: Site) -> None:
    """Fail before anything is planned on a scheduler that does not answer, or on arguments that a class does not take.

    Raises:
        UserError: as said.
    """
    if site.scheduler:
        with _client(site.scheduler, f"--scheduler {site.scheduler}"):
            return
    made = _load_class(site.file.kind, site.source)
    command = str(getattr(getattr(made, "job_cls", None), "submit_command", ""))
    if command and shutil.which(command.split()[0]) is None:
        raise UserError(f"{site.source}: {site.file.kind} calls the command {command.split()[0]}, which is not here.")


@contextmanager
def connected(site: Site, most: int) -> Iterator["Client"]:
    """Give a client of the cluster; workers that were started for it end with the block.

    Args:
        site: where to run.
        most: workers that have something to do; no more are started.

    Raises:
        UserError: the scheduler does not answer, or the cluster cannot be started.
    """
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # lost workers are expected, and told by our own line
    logging.getLogger("asyncio").setLevel(logging.CRITICAL)
    if site.scheduler:
        with _client(site.scheduler, f"--scheduler {site.scheduler}") as client:
            yield client
        return
    import dask

    settings = {"distributed.scheduler.allowed-failures": site.file.retries}
    with dask.config.set(settings), _started(site, most) as cluster, _client(cluster, site.source) as client:
        yield client


@contextmanager
def _started(site: Site, most: int) -> Iterator[Any]:
    kind, workers = _load_class(site.file.kind, site.source), max(1, min(site.file.workers, most))
    # A worker makes one run at a time, with one thread. What the file says of memory is the job's; of workers on this
    # machine nothing is killed that the system lets live.
    given = dict(site.file.arguments)
    if site.file.kind == LOCAL:
        local = {"memory_limit": 0, "threads_per_worker": 1, "processes": True, "silence_logs": logging.CRITICAL}
        given = {**local, **given, "n_workers": workers}
    elif hasattr(kind, "job_cls"):
        given = {"processes": given.get("cores", 1), **given}
        if given.get("cores", 1) != given["processes"]:
            raise UserError(
                f"{site.source}: expected as many `processes` as `cores` (a run has one thread), got "
                f"{given['processes']} and {given.get('cores')}."
            )
    try:
        with _deaf(), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the dashboard's usual port may be taken; the address is printed
            cluster = kind(**given)
    except (TypeError, ValueError, RuntimeError, OSError) as error:
        raise UserError(f"{site.source}: {site.file.kind} could not be started: {reason(error)}.") from error
    try:
        if hasattr(kind, "job_cls"):  # `scale` would start no worker in the place of a lost one
            cluster.adapt(minimum=workers, maximum=workers)
        elif site.file.kind != LOCAL:
            cluster.scale(workers)
        yield cluster
    finally:
        with contextlib.suppress(Exception):  # the runs are made; what cannot be closed ends with this process
            cluster.close(timeout=10)


@contextmanager
def _client(address: Any, name: str) -> Iterator["Client"]:
    from distributed import Client

    try:
        with _deaf():
            client = Client(address, timeout=PATIENCE, set_as_default=False, name="rewild4d")
    except (OSError, ValueError, TypeError, TimeoutError) as error:
        raise UserError(f"{name}: expected a Dask scheduler, but none answers: {reason(error)}.") from error
    try:
        yield client
    finally:
        with contextlib.suppress(Exception):
            client.close(timeout=5)


@contextmanager
def _deaf() -> Iterator[None]:
    """Start threads and processes that Ctrl-C does not reach: it is for this one, which ends them."""
    if os.name == "posix":
        resource_tracker.ensure_running()  # started later, by the first process, it would unblock Ctrl-C
    block_interrupts(True)
    try:
        yield
    finally:
        block_interrupts(False)
