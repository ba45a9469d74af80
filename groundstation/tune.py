"""``pipewright tune``: seek the parameters with which the worst run of a campaign is best."""

from __future__ import annotations

import argparse
import fcntl
import re
import sys
from argparse import RawDescriptionHelpFormatter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from groundstation.campaign import add_pool_options, pool_size
from groundstation.codes import BROKEN, DONE, INTERRUPTED, NOT_THERE, WRONG_INPUT

if TYPE_CHECKING:
    from groundstation.campaign_pool import Pool
    from groundstation.tune_file import Study

_EPILOG: Final = """\
examples:
  pipewright tune contact --workers 2                 a shipped tuning (configs/tunings)
  pipewright tune my.yaml --out runs/my-study         again with the same --out: goes on where it was
  pipewright sim --scenario runs/my-study/best.yaml   fly what was found
"""
_JOURNAL: Final = "study.journal"
#: Trials that are flown whole before any is broken off half way.
_STARTUP: Final = 8


def add_parser(commands: argparse._SubParsersAction[Any]) -> None:
    """The command on the command line."""
    words = "seek the parameters with which a campaign's worst run is best"
    command = commands.add_parser(
        "tune",
        help=words,
        description=words.capitalize() + ".",
        epilog=_EPILOG,
        formatter_class=RawDescriptionHelpFormatter,
    )
    command.add_argument("file", metavar="NAME|FILE", help="a shipped tuning, or a file (docs/campaigns.md)")
    add_pool_options(command)
    command.add_argument("--trials", type=int, metavar="N", help="in all, in place of the file's")
    command.add_argument("--out", type=Path, metavar="DIR", help="folder of the study (default: runs/tune-NAME)")
    command.add_argument("--page", type=Path, metavar="FILE.md", help="where its report goes (default: in the folder)")
    command.add_argument("--no-progress", action="store_true", help="no progress bar")
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Make the trials that are missing, then write the best and the report; gives the exit code."""
    from groundstation.campaign_pool import PoolError, pool
    from groundstation.tune_file import read_tuning
    from onboard.headless import ConfigError

    try:
        workers = pool_size(options)
        study = read_tuning(options.file)
        trials = study.tuning.trials if options.trials is None else options.trials
        folder = options.out or Path("runs") / ("tune-" + re.sub(r"[^\w.-]+", "_", study.name))
        with _alone(folder):
            search = _opened(study, folder)
            try:
                if _finished(search) < trials:
                    with pool(workers, options.scheduler) as flying:
                        _seek(study, search, flying, trials, options)
                interrupted = False
            except KeyboardInterrupt:
                interrupted = True
            if not _finished(search):
                print("pipewright: no trial was finished", file=sys.stderr)
                return INTERRUPTED if interrupted else BROKEN
            _conclude(study, search, folder, options.page)
    except ConfigError as error:
        print(error, file=sys.stderr)
        return WRONG_INPUT
    except PoolError as error:
        print(error, file=sys.stderr)
        return NOT_THERE
    return INTERRUPTED if interrupted else DONE


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    from onboard.headless import ConfigError

    folder.mkdir(parents=True, exist_ok=True)
    with (folder / ".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigError([f"{folder}: another process is at work on it; wait for it or end it"]) from None
        yield


def _opened(study: Study, folder: Path) -> Any:
    """The study of the folder, as it was left; begun with the parameters in force, so that none is worse than they."""
    import optuna
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend
    from optuna.trial import TrialState

    from groundstation.tune_file import present
    from onboard.headless import ConfigError

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    storage = JournalStorage(JournalFileBackend(str(folder / _JOURNAL)))
    search = optuna.create_study(
        storage=storage,
        study_name=study.name,
        load_if_exists=True,
        direction="minimize",
        sampler=optuna.samplers.TPESampler(seed=study.tuning.seed, n_startup_trials=_STARTUP),
        pruner=optuna.pruners.MedianPruner(n_startup_trials=_STARTUP, n_warmup_steps=max(1, study.length // 3)),
    )
    former = search.user_attrs.get("digest")
    if former is None:
        search.set_user_attr("digest", study.digest())
        search.enqueue_trial(present(study), skip_if_exists=True)
    elif former != study.digest():
        raise ConfigError(
            [f"{folder}: holds the study of another tuning: its file has been changed; give another --out"]
        )
    for left in search.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
        search.tell(left.number, state=TrialState.FAIL)
        search.enqueue_trial(left.params)
    return search


def _finished(search: Any) -> int:
    from optuna.trial import TrialState

    return len(search.get_trials(deepcopy=False, states=(TrialState.COMPLETE, TrialState.PRUNED)))


def _seek(study: Study, search: Any, flying: Pool, trials: int, options: argparse.Namespace) -> None:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    shown = not options.no_progress and sys.stderr.isatty()
    columns = [
        TextColumn(study.name), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn(),
        TextColumn("{task.fields[words]}"),
    ]  # fmt: skip
    with Progress(*columns, console=Console(stderr=True), disable=not shown, transient=True) as bar:
        task = bar.add_task("", total=trials, completed=_finished(search), words="")
        while _finished(search) < trials:
            _trial(study, search, flying)
            best = f"best {search.best_value:.4f}" if any(t.state.name == "COMPLETE" for t in search.trials) else ""
            bar.update(task, completed=_finished(search), words=best)


def _trial(study: Study, search: Any, flying: Pool) -> None:
    """Make one trial; it is broken off when the runs flown so far are worse than those of most others were."""
    from optuna.trial import TrialState

    from groundstation.campaign_run import failed, flown

    trial = search.ask()
    values = {name: _suggested(trial, study, name) for name in study.ranges}
    rows: list[dict[str, Any]] = []
    runs = flying.each(flown, study.jobs(values), failed)
    try:
        for row in runs:
            rows.append(row)
            trial.report(study.tuning.objective.value(rows), len(rows))
            if len(rows) < study.length and trial.should_prune():
                search.tell(trial, state=TrialState.PRUNED)
                return
    finally:
        runs.close()
    trial.set_user_attr("ends", [row["end"] for row in rows])
    trial.set_user_attr("figures", [row[study.tuning.objective.metric] for row in rows])
    search.tell(trial, study.tuning.objective.value(rows))


def _suggested(trial: Any, study: Study, name: str) -> Any:
    bounds = study.ranges[name]
    log = next(item.log for item in study.tuning.parameters if item.name == name)
    if bounds.choices:
        return trial.suggest_categorical(name, list(bounds.choices))
    if bounds.whole:
        return trial.suggest_int(name, int(bounds.low), int(bounds.high), log=log)
    return float(f"{trial.suggest_float(name, bounds.low, bounds.high, log=log):.6g}")


def _conclude(study: Study, search: Any, folder: Path, page: Path | None) -> None:
    from groundstation import tune_report

    best = tune_report.write_best(study, search, folder)
    report = page or folder / "study.md"
    tune_report.write(study, search, report)
    print(f"{study.name}: {_finished(search)} trials; best {search.best_value:.4f} (trial {search.best_trial.number})")
    for name, value in best.items():
        print(f"  --set {name}={value}")
    print(f"\n{folder / 'best.yaml'} flies it: pipewright sim --scenario {folder / 'best.yaml'}\nreport: {report}")
