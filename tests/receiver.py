"""A receiver that a test may kill: appends each message once to a file, then acknowledges.

`python -m tests.receiver ENDPOINT CHANNEL FILE`. A line is `actor boot seq payload-in-hex`; what is in the
file when it starts counts as seen. What was written before SIGKILL is there after it: no need to sync.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from common.delivery import DuplicateFilter, Parcel, Receiver
from common.link import make_link, open_hub
from common.messages import MEGABYTE, Origin


def main(endpoint: str, channel: str, file: str) -> None:
    """Serves until killed; a line torn by the last kill is cut off first."""
    path, seen = Path(file), DuplicateFilter()
    text = path.read_text() if path.exists() else ""
    text = text[: text.rfind("\n") + 1]
    path.write_text(text)
    for line in text.splitlines():
        actor, boot, seq, _ = line.split(" ")
        seen.add(Origin(actor=actor, boot=boot, seq=int(seq)))
    out = path.open("a")

    def take(parcel: Parcel) -> None:
        origin = parcel.origin
        out.write(f"{origin.actor} {origin.boot} {origin.seq} {parcel.payload.hex()}\n")
        out.flush()
        seen.add(origin)
        time.sleep(0.001)  # a bundle takes long enough to be killed in the middle of it

    with open_hub(make_link(endpoint)) as hub:
        _receiver = Receiver(hub, channel, take, seen.seen, MEGABYTE)
        print("up", flush=True)
        time.sleep(120)


if __name__ == "__main__":
    main(*sys.argv[1:])
