"""The `navaclq` command: one module per group of commands, and one way to report wrong use."""

from __future__ import annotations

import signal
import sys
from typing import NoReturn

import typer
from typer.exceptions import TyperException

from common.errors import NoAnswerError, RefusedError, RunError, UsageError
from common.messages import MessageError
from common.signals import give_again
from deploy.cli import (
    bench,
    certs,
    config,
    curriculum,
    doctor,
    evaluate,
    pretrain,
    processes,
    top,
    train,
    world,
)

app = typer.Typer(
    name="navaclq",
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Train mobile robots to dock from camera and LiDAR: distributed SAC with an automatic curriculum.",
)
app.command("train")(train.train)
app.command("pretrain")(pretrain.pretrain)
app.command("learner")(processes.learner)
app.command("actor")(processes.actor)
app.command("router")(processes.router)
app.command("evaluate")(evaluate.evaluate)
app.command("top")(top.top)
app.command("doctor")(doctor.doctor)
app.add_typer(curriculum.app, name="curriculum")
app.add_typer(world.app, name="world")
app.add_typer(bench.app, name="bench")
app.add_typer(config.app, name="config")
app.add_typer(certs.app, name="certs")


def run() -> NoReturn:
    """Runs a command and exits: 0 on success, 2 on wrong use with one sentence, 1 on failure."""
    give_again(KeyboardInterrupt, signal.SIGINT)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        code = app(standalone_mode=False)
    except UsageError as error:
        sys.stderr.write(f"error: {error}\n")
        sys.exit(2)
    except (NoAnswerError, RefusedError, MessageError, RunError) as error:
        sys.stderr.write(f"error: {error}\n")
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit(130)
    except TyperException as error:
        message = error.format_message()
        sys.stderr.write(f"error: {message or 'a command is missing; see navaclq --help'}\n")
        sys.exit(2)
    sys.exit(code if isinstance(code, int) else 0)
