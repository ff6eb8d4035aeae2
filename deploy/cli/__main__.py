"""The command `navaclq`, also as `python -m deploy.cli`."""

import os
import signal

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # NumPy's products are small here: two threads would spin
signal.signal(signal.SIGINT, signal.SIG_DFL)  # until a command handles it, Ctrl-C ends all without a word


def run() -> None:
    """Loads the commands and runs one; does not return."""
    import traceback

    from common.link import end_process
    from deploy.cli.main import run as run_command

    try:
        run_command()
    except SystemExit as end:
        end_process(end.code if isinstance(end.code, int) else 0)
    except KeyboardInterrupt:  # just before the command heeds it
        end_process(130)
    except BaseException:
        traceback.print_exc()
        end_process(1)


if __name__ == "__main__":
    run()
