"""Independent fits, one after the other or on a Dask cluster, each kept as one line of a file as soon as it is done."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rfdropo_bayes.discrepancy.deadline import INTERRUPT
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import append_line, read_lines, write_text
from rfdropo_bayes.inference.progress import Progress
from rfdropo_bayes.verbs.audit import Audit

LOCAL = "local"
RETRIES = 3  # of a fit whose worker died

Job = Mapping[str, Any]


def run_fits(
    jobs: Sequence[Job],
    fit: Callable[[Job], dict[str, Any]],
    log: Path,
    *,
    resume: bool = False,
    cluster: str | None = None,
    progress: Progress | None = None,
) -> list[dict[str, Any]]:
    """Do every job that the log does not hold yet, and return the results of all, in the order of the jobs.

    Args:
        jobs: plain dictionaries that tell the fits apart.
        fit: what to do with one; it is sent to the workers, so it is a function of a module.
        log: file of one JSON line per finished fit.
        resume: keep what the log holds; else it is started anew.
        cluster: ``"local"`` for a Dask cluster of this machine's processors, or the address of a scheduler; None does
            all in this process. A worker that dies costs the fits it was at, which are done again elsewhere.
        progress: where to report.

    Raises:
        InputError: a cluster is asked for and Dask is missing or does not answer.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    known = _read(log) if resume else {}
    write_text(log, "".join(_line(job, result) + "\n" for job, result in known.values()))
    left = [job for job in jobs if _name(job) not in known]
    for count, (job, result) in enumerate(_results(left, fit, cluster)):
        append_line(log, _line(job, result))
        known[_name(job)] = (dict(job), result)
        if progress is not None:
            progress.stage((len(jobs) - len(left) + count + 1) / len(jobs), **job)
    return [{**job, **known[_name(job)][1]} for job in jobs]


def uninterrupted(found: Audit) -> Audit:
    """An audit that was done to the end, or to its time; the results of an interrupted audit are no row of a study.

    Raises:
        KeyboardInterrupt: the audit was interrupted.
    """
    if found.content["stopped"] == INTERRUPT:
        raise KeyboardInterrupt
    return found


def finished(jobs: Sequence[Job], log: Path) -> list[dict[str, Any]]:
    """Results of the jobs that the log holds, as `run_fits` returns them; nothing is done."""
    known = _read(log)
    return [{**job, **known[_name(job)][1]} for job in jobs if _name(job) in known]


def _results(
    jobs: Sequence[Job], fit: Callable[[Job], dict[str, Any]], cluster: str | None
) -> Iterator[tuple[Job, dict[str, Any]]]:
    if cluster is None or not jobs:
        for job in jobs:
            yield job, fit(job)
        return
    with _client(cluster) as client:
        from distributed import as_completed

        futures = {client.submit(fit, dict(job), retries=RETRIES, pure=False): job for job in jobs}
        for future in as_completed(futures):
            yield futures[future], future.result()


def _client(cluster: str) -> Any:
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        raise InputError(
            "Dask is not installed", where="--cluster", remedy="install it: pip install -r studies/requirements.txt"
        ) from None
    try:
        # One thread to a worker: a fit uses the processors itself.
        if cluster == LOCAL:
            return Client(LocalCluster(threads_per_worker=1, dashboard_address=None))
        return Client(cluster, timeout=10)
    except OSError as error:
        raise InputError(
            f"no scheduler answers ({error})", where=f"--cluster {cluster}", remedy="start one with `dask scheduler`"
        ) from None


def _name(job: Job) -> str:
    return json.dumps(dict(job), sort_keys=True)


def _line(job: Job, result: Mapping[str, Any]) -> str:
    return json.dumps({"job": dict(job), "result": dict(result)})


def _read(log: Path) -> dict[str, tuple[dict[str, Any], dict[str, Any]]]:
    return {_name(row["job"]): (row["job"], row["result"]) for row in read_lines(log)}
