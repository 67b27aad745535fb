"""The program: its commands, and how it ends when something goes wrong (one line, an exit code, no traceback)."""

from __future__ import annotations

import os
import sys
import traceback
import warnings
from collections.abc import Sequence
from typing import Annotated, NoReturn

import typer

from cluster_slam import __version__
from cluster_slam.cli import (
    calibrate,
    check,
    compare,
    detect,
    evaluate,
    experiment,
    exporting,
    figures,
    importing,
    localise,
    record,
    reproduce,
    rtde_emulator,
    simulate,
    smooth,
    track,
)
from cluster_slam.cli import map as map_commands
from cluster_slam.errors import ClusterSlamError

EXIT_POOR = 1  # it ran, but the result is poor
EXIT_BAD_INPUT = 2  # bad input, bad options, or no place to write
EXIT_BUG = 70  # EX_SOFTWARE of sysexits.h
EXIT_INTERRUPTED = 130  # 128 + SIGINT

app = typer.Typer(
    name="cluster-slam",
    help="Which flower cluster is this? Landmark SLAM with clusters of flowers.",
    epilog="Start here: cluster-slam simulate demo --preset sample, then cluster-slam smooth demo -o result",
    add_completion=False,
    rich_markup_mode=None,  # plain help is there 0.1 s sooner
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _show_version(value: bool) -> None:
    if value:
        typer.echo(f"cluster-slam {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
    debug: Annotated[
        bool, typer.Option("--debug", help="Show the traceback of an error (anywhere on the line).")
    ] = False,
) -> None:
    """Options of all commands; ``main`` has taken ``--debug`` out before."""


app.command("smooth", short_help="Turn a session into a map of flower clusters.")(smooth.command)
app.command("track", short_help="Follow clusters frame by frame, as if live.")(track.command)
app.command("simulate")(simulate.command)
app.command("evaluate")(evaluate.command)
app.command("check")(check.command)
app.command("detect", short_help="Find flowers in pictures.")(detect.command)
app.command("figures")(figures.command)
app.command("compare-descriptors")(compare.command)
app.command("calibrate")(calibrate.command)
app.command("experiment")(experiment.command)
app.command("localise")(localise.command)
app.command("record")(record.command)
app.command("import")(importing.command)
app.command("export")(exporting.command)
app.command("rtde-emulator")(rtde_emulator.command)
app.add_typer(reproduce.app, name="reproduce")
app.add_typer(map_commands.app, name="map")


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the program and exit: 0, 1 poor result, 2 bad input or usage, 70 bug, 130 interrupted.

    Parameters
    ----------
    arguments
        Those of the command line without the program's name; None: ``sys.argv``.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in given
    if not debug:
        warnings.simplefilter("ignore")
    sys.exit(run([argument for argument in given if argument != "--debug"], debug=debug))


def run(arguments: Sequence[str], *, debug: bool = False) -> int:
    """Run the program and return its exit code; errors end in one line on stderr."""
    try:
        code = app(list(arguments) or ["--help"], prog_name="cluster-slam", standalone_mode=False)
        sys.stdout.flush()
    except BrokenPipeError:
        return _reader_gone()
    except SystemExit as end:  # typer's own way to end on a broken pipe
        if isinstance(end.__context__, BrokenPipeError):
            return _reader_gone()
        raise
    except (typer.Abort, KeyboardInterrupt):
        code = EXIT_INTERRUPTED
    except Exception as error:
        if debug:
            traceback.print_exc()
        return _explain(error)
    if code == EXIT_INTERRUPTED:  # typer's answer to Ctrl-C
        _say("interrupted; nothing has been written")
    return code if isinstance(code, int) else 0


def _reader_gone() -> int:
    """Whoever read our output has left, as in ``... | head``: that is no error."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


def _explain(error: Exception) -> int:
    usage = getattr(error, "format_message", None)  # an error of typer's own: unknown option, missing argument
    if isinstance(error, ClusterSlamError):
        _say(str(error))
    elif callable(usage) and type(error).__name__ == "NoArgsIsHelpError":  # a group without a command, as in "map"
        typer.echo(usage())
        return 0
    elif callable(usage):
        context = getattr(error, "ctx", None)
        _say(f"{usage()} (see {context.command_path if context else 'cluster-slam'} --help)")
    else:
        where = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{os.path.basename(where.filename)}:{where.lineno}"
        _say(f"a bug in cluster-slam, {type(error).__name__} at {place}: {error} (--debug shows where it comes from)")
        return EXIT_BUG
    return EXIT_BAD_INPUT


def _say(text: str) -> None:
    print(f"cluster-slam: {' '.join(text.split())}", file=sys.stderr)  # noqa: T201
