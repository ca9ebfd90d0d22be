"""The ``gsim3d`` command: make and check data, train, simulate, evaluate, import, and tell what is wrong."""

import argparse
import contextlib
import importlib
import sys
import warnings
from functools import partial
from typing import Any

from gsim3d.cli.arguments import Parser
from gsim3d.errors import CaptureError, FitWarning, InputError, NumericalError, RunStopped, did_you_mean
from gsim3d.io.terminal import Terminal

# command -> (module with add_arguments(parser) and run(args), what it does); modules load when they are called
COMMANDS = {
    "generate": ("gsim3d.cli.generate", "make a data set: multi-view video of simulated bodies that fall"),
    "bound": ("gsim3d.cli.bound", "the scores that a perfect simulator has on a generated data set"),
    "check-data": ("gsim3d.cli.check_data", "what is wrong with recorded scenes, and a picture of their cameras"),
    "calibrate": ("gsim3d.cli.calibrate", "cameras of own videos, from a ChArUco board or structure from motion"),
    "capture": ("gsim3d.cli.capture", "from own videos to a simulator: calibrate, check, prepare, train, score"),
    "train": ("gsim3d.cli.train", "learn a simulator from a data set"),
    "simulate": ("gsim3d.cli.simulate", "predict the future of one scene: video and .ply"),
    "export": ("gsim3d.cli.export", "write 3D Gaussians for other tools: .spz, .splat, .glb, USD, a video"),
    "view": ("gsim3d.cli.view", "look around in a prediction or a scene, in a browser"),
    "plan": ("gsim3d.cli.plan", "which effects of a scene are computed, and what that costs"),
    "effects": ("gsim3d.cli.effects", "find out which effects a scene needs"),
    "evaluate": ("gsim3d.cli.evaluate", "measure predictions on a data set, beside baselines and other models"),
    "profile": ("gsim3d.cli.profile", "what accuracy costs in time: a report, and settings that keep a promise"),
    "ablate": ("gsim3d.cli.ablate", "the paper's ablations: the same training with one change, in one table"),
    "reproduce": ("gsim3d.cli.reproduce", "the paper's tables and figures with models at hand, on one page"),
    "weights": ("gsim3d.cli.weights", "install the weights of LPIPS and FVD"),
    "import": ("gsim3d.cli.import_released", "convert a checkpoint of the authors' release: the same predictions"),
    "demo": ("gsim3d.cli.demo", "all of it at a small size, in minutes on a CPU"),
    "doctor": ("gsim3d.cli.doctor", "what is installed, what was compiled, and whether every kernel works here"),
}
RENAMED = {"pareto": "profile"}


def main(arguments: list[str] | None = None) -> int:
    """Runs one command; the exit code is 0, or 2 with one line on stderr where the input is wrong."""
    arguments = sys.argv[1:] if arguments is None else arguments
    with contextlib.redirect_stdout(Terminal(sys.stdout)), contextlib.redirect_stderr(Terminal(sys.stderr)):
        try:
            return _command(arguments)
        finally:
            with contextlib.suppress(OSError):  # of a full disk, said before
                sys.stdout.flush()


def command(name: str) -> tuple[Any, Parser]:
    """The module of a command, and its parser, which shows the module's docstring with --help."""
    module = importlib.import_module(COMMANDS[name][0])
    about, _, epilog = (module.__doc__ or "").partition("\n\n")
    parser = Parser(prog=f"gsim3d {name}", description=about, epilog=epilog)
    module.add_arguments(parser)
    return module, parser


def _command(arguments: list[str]) -> int:
    name = arguments[0] if arguments else None
    args = argparse.Namespace()
    try:
        if name not in COMMANDS:
            return _no_command(arguments)
        with warnings.catch_warnings():
            warnings.simplefilter("default", FitWarning)
            warnings.showwarning = partial(_show_warning, warnings.showwarning)
            module, parser = command(name)
            args = parser.parsed(arguments[1:])
            code = module.run(args) or 0
            sys.stdout.flush()
            return code
    except (InputError, NumericalError, CaptureError) as error:
        return _fail(str(error))
    except RunStopped as error:
        _fail(str(error))
        return error.code
    except UnicodeEncodeError as error:
        return _fail(f"{error.object[:200]!r}: names must be valid Unicode")
    except OSError as error:  # a full disk names no file
        path = error.filename or getattr(args, "out", None)
        return _fail(f"{path}: {error.strerror}" if path and error.strerror else str(error))
    except (RuntimeError, MemoryError) as error:
        from gsim3d.cuda_graphs import is_out_of_memory

        if not is_out_of_memory(error):
            raise
        return _fail(f"out of memory: {str(error).splitlines()[0][:200] if str(error) else type(error).__name__}")
    except KeyboardInterrupt:
        print("gsim3d: interrupted", file=sys.stderr)
        return 130


def _no_command(arguments: list[str]) -> int:
    """Help, the version, or what is wrong with the first word."""
    lines = [f"  {name:<10} {text}" for name, (_, text) in COMMANDS.items()]
    hints = ["", "A first try: gsim3d demo --out runs/demo", "Help on one command: gsim3d train --help"]
    usage, what = "gsim3d [--help] [--version] COMMAND ...", "Learns 3D simulators from multi-view video."
    parser = Parser(prog="gsim3d", description=what, epilog="\n".join(["commands:", *lines, *hints]), usage=usage)
    parser.add_argument("--version", action="store_true", help="print the version and exit")
    parser.add_argument("command", nargs="?", metavar="COMMAND", help="one of the commands below")
    known, _ = parser.parse_known_args(arguments)
    if known.version:
        from gsim3d import __version__

        print(f"gsim3d {__version__}")
        return 0
    if known.command is None and not arguments:
        parser.print_help()
        return 0
    given = known.command or arguments[0]
    if given in COMMANDS:
        parser.error(f"the command comes first: gsim3d {given} ...; got {arguments[0]!r} before it")
    if given in RENAMED:
        parser.error(f"gsim3d {given} is now gsim3d {RENAMED[given]}")
    hint = did_you_mean(given, (*COMMANDS, "--version", "--help"))
    parser.error(f"unknown command {given!r}; commands: {', '.join(COMMANDS)}{hint}")


def _show_warning(otherwise, message, category, *location, **more) -> None:
    if issubclass(category, FitWarning):
        print(f"gsim3d: {message}", file=sys.stderr)
    else:
        otherwise(message, category, *location, **more)


def _fail(message: str) -> int:
    print(f"gsim3d: error: {' '.join(message.split())[:2000]}", file=sys.stderr)  # names of files may be longer
    return 2
