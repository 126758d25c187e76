"""`hno`: one command line for everything. Nothing heavy is imported before a command needs it."""

from __future__ import annotations

import os
import pkgutil
import sys
from collections.abc import Sequence
from typing import NamedTuple

import hno
from hno.cli.arguments import FLAGS, Arguments, UsageError, one_screen, parse, quoted
from hno.processes import Interrupted, interruptible
from hno.registry import UnknownNameError, unknown_name


class Command(NamedTuple):
    """One of the commands."""

    run: str
    """Where its function lies, (Arguments) -> exit code."""
    usage: str
    """Words after its name."""
    about: str
    """What it does; the first sentence stands in the list of commands."""
    config: str | None = None
    """Its root configuration, if it has one."""
    word: str | None = None
    """What a word without a flag or = sets."""
    to: tuple[str, ...] = ()
    """Keys that --to sets."""
    flags: tuple[str, ...] = ()
    """Flags besides --help and --version."""


JOBS = tuple(name for name in FLAGS if name not in ("--help", "--version", "--no-window"))
FOLDERS = ("hydra.run.dir", "hydra.sweep.dir")
SEARCHED = """
  key=a,b                     one of these
  'key=range(8,65,8)'         8, 16, ..., 64
  'key=interval(0,1)'         a number between; 'key=int(interval(1,9))': a whole one
  'key=tag(log,interval(1e-4,1e-2))'

  objective=[a,b]             numbers of results.json that are minimised, one or several
  trials=20                   of the whole study
  search=tpe                  who proposes: tpe, random, nsga2, gp; search.seed=0, search.<option of Optuna's>
  pruner=median               ends hopeless runs: median, halving; pruner.<option of Optuna's>
  at_once=4                   trials that are launched together; by default as many as joblib has processes, or 1
  storage=URL study=NAME      a database that machines share; by default study.db in the folder
  sweep=FOLDER                go on with the search there""".strip("\n")
"""Words of `hno tune`."""
COMMANDS = {
    "train": Command(
        "hno.cli.train:run", "[group=choice ...] [key=value ...] [-m]",
        "Solve labels, train an operator and evaluate it. The run's folder gets checkpoints, metrics and results.json.",
        "train", to=FOLDERS, flags=JOBS,
    ),
    "tune": Command(
        "hno.cli.tune:run", "key=interval(A,B) key=a,b ... [key=value ...] [trials=20] [storage=URL study=NAME]",
        f"Search settings of a training with Optuna. Keys are those of hno train; searched are\n{SEARCHED}",
        "train", to=FOLDERS, flags=("--dry-run", "--to", "--config-dir", "--shell-completion"),
    ),
    "evaluate": Command(
        "hno.cli.evaluate:run", "checkpoint=FILE [key=value ...] [-m]",
        "Evaluate checkpoints. How often they collide, where they err, and how they compare on the same starts.",
        "evaluate", "checkpoint", FOLDERS, JOBS,
    ),
    "certify": Command(
        "hno.cli.certify:run", "RUN|CHECKPOINT|EXPORTED [key=value ...]",
        "Bound the probability of collision. By independent tests, with a stated confidence; refused where they chose "
        "the model.",
        "certify", "checkpoint", flags=("--dry-run", "--config-dir"),
    ),
    "labels": Command(
        "hno.cli.labels:run", "game=NAME theta=TYPES n=STARTS [key=value ...]",
        "Solve open-loop equilibria and keep them with their certificates. What was stopped goes on where it was.",
        "labels", to=("cache",), flags=("--dry-run", "--to", "--config-dir"),
    ),
    "report": Command(
        "hno.cli.pages:run", "FOLDER [key=value ...]",
        "Write a page about a run or a sweep, or figures for documents.",
        "report", "folder", ("to",), ("--dry-run", "--to"),
    ),
    "episodes": Command(
        "hno.cli.episodes:run", "RUN --to csv|commonroad|mcap [folder=FOLDER]",
        "Write a run's episodes for other programs. States, controls and values at every step, with the equilibrium's; "
        "into RUN/episodes by default.",
        flags=("--to",),
    ),
    "export": Command(
        "hno.cli.export:run", "RUN|CHECKPOINT --to numpy|c|onnx|torch [folder=FOLDER]",
        "Write a controller that runs without this package. It is compared with the checkpoint before it is written.",
        flags=("--to",),
    ),
    "simulate": Command(
        "hno.cli.simulate:run", "ARTEFACT [ARTEFACT2] [theta=2,4] [drive=1] [seed=0] [speed=0.5] [port=0]",
        "Let exported controllers play in a browser window, or drive one player yourself. The arrow keys (and W, S) "
        "are its controls.",
        flags=("--no-window",),
    ),
    "list": Command(
        "hno.cli.listing:run", "[KIND ...]",
        "List what is registered: games, methods, networks, activations, losses, sources, optimizers and callbacks, "
        "each with the package that it comes from.",
    ),
    "new-game": Command(
        "hno.cli.new_game:run", "NAME [--to FOLDER]",
        "Write a small working game as a package of its own, with its configuration and its test.",
        flags=("--to",),
    ),
    "check-game": Command(
        "hno.cli.check_game:run", "NAME|MODULE:CLASS [game.constants.NAME=VALUE ...]",
        "Check a game, and say in plain words what is wrong with it. The exit code is 0 if nothing is.",
    ),
}  # fmt: skip


def main(given: Sequence[str] | None = None, prog: str | None = None) -> int:
    """Entry point.

    Args:
        given: the words after the program's name; those of the process by default.
        prog: how the command was called, for its help.

    Returns:
        The exit code: 2 if the command was refused before any work, 1 if work failed, 128 and the signal's number if
        one ended it.
    """
    name, *rest = [*(sys.argv[1:] if given is None else given)] or ["--help"]
    try:
        if name in ("-h", "--help", "help", "--version"):
            print(f"hno {hno.__version__}" if name == "--version" else _overview(), flush=True)
            return 0
        if name not in COMMANDS:
            raise UsageError(unknown_name("command", name, list(COMMANDS)))
        with interruptible():
            return _run(COMMANDS[name], parse(rest), prog or f"hno {name}")
    except BrokenPipeError:  # whoever read what is printed has read enough, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (UnknownNameError, OSError, ValueError) as error:
        print(one_screen(str(error)), file=sys.stderr)
        return 2 if isinstance(error, UsageError) else 1
    except Interrupted as stop:
        print(". ".join([f"Interrupted by {stop}", *getattr(stop, "__notes__", [])]) + ".", file=sys.stderr)
        return stop.code
    except KeyboardInterrupt:  # of a program that calls this in a thread
        print("Interrupted.", file=sys.stderr)
        return 130


def _run(command: Command, given: Arguments, prog: str) -> int:
    if "--version" in given.flags:
        print(f"hno {hno.__version__}")
        return 0
    refused = [flag for flag in given.flags if flag not in (*command.flags, "--help")]
    if refused:
        raise UsageError(f"{prog} takes no {refused[0]}; its flags are {', '.join((*command.flags, '--help'))}.")
    if "--help" in given.flags:
        print(_help(command, given, prog), flush=True)
        return 0
    if command.config is not None and "--shell-completion" in given.flags:
        from hno.cli.config import complete

        complete(command.config, given.overrides)
        return 0
    return int(pkgutil.resolve_name(command.run)(_configured(command, given, prog)))


def _configured(command: Command, given: Arguments, prog: str) -> Arguments:
    """A bare word and --to as the overrides that they stand for, where the command has a configuration."""
    if command.config is None:
        return given
    words, overrides = given.words, given.overrides
    if command.word is not None:  # a path that is there is no key=value, whatever its name
        words = [*words, *(entry for entry in overrides if os.path.exists(entry))]  # noqa: PTH110  # no error for any name
        overrides = [entry for entry in overrides if entry not in words]
    if len(words) > (command.word is not None):
        raise UsageError(f"{prog}: what is {words[-1]!r}? Usage: {prog} {command.usage}")
    stands_for = [f"{command.word}={quoted(word)}" for word in words]
    stands_for += [f"{key}={quoted(given.flags['--to'])}" for key in command.to if "--to" in given.flags]
    return given._replace(words=[], overrides=[*overrides, *stands_for])


def _overview() -> str:
    lines = ["Usage: hno COMMAND ...", ""]
    lines += [f"  {name:<12}{command.about.split('. ')[0].rstrip('.')}" for name, command in COMMANDS.items()]
    return "\n".join([*lines, "", "hno COMMAND --help says more; hno --version prints the version."])


def _help(command: Command, given: Arguments, prog: str) -> str:
    flags = (*command.flags, "--help", "--version")
    shown = [f"  {name:<20}{about}" for name, about in FLAGS.items() if name in flags]
    parts = [f"Usage: {prog} {command.usage}", command.about, "\n".join(["Flags", *shown])]
    if command.config is not None:
        from hno.cli.help import configuration_help

        parts.append(configuration_help(command.config, given))
    return "\n\n".join(parts)
