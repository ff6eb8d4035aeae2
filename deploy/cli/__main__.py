"""The command `navaclq`, also as `python -m deploy.cli`."""

import signal
import traceback
from typing import NoReturn


def run() -> NoReturn:
    """Loads the commands, during which Ctrl-C ends the process without a word, and runs one."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    from common.link import end_process
    from deploy.cli.main import run as run_command

    try:
        run_command()
    except SystemExit as end:
        end_process(end.code if isinstance(end.code, int) else 0)
    except BaseException:
        traceback.print_exc()
        end_process(1)


if __name__ == "__main__":
    run()
