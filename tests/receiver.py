"""A receiver that a test may kill: appends each message once to a file, then acknowledges.

`python -m tests.receiver ENDPOINT KEY FILE`. A line is `actor boot seq payload-in-hex`; what is in the file
when it starts counts as seen.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

from common.bus import QueryServer, open_hub
from common.delivery import DuplicateFilter, unpack_header
from common.messages import Acknowledgement, Origin, encode


def main(endpoint: str, key: str, file: str) -> None:
    """Serves until killed; a line torn by the last kill is cut off first."""
    path, seen = Path(file), DuplicateFilter()
    text = path.read_text() if path.exists() else ""
    text = text[: text.rfind("\n") + 1]
    path.write_text(text)
    for line in text.splitlines():
        actor, boot, seq, _ = line.split(" ")
        seen.add(Origin(actor=actor, boot=boot, seq=int(seq)))
    out = path.open("a")

    def receive(payload: bytes, header: bytes) -> bytes:
        origin = unpack_header(header, payload)
        duplicate = seen.seen(origin)
        if not duplicate:
            out.write(f"{origin.actor} {origin.boot} {origin.seq} {payload.hex()}\n")
            out.flush()
            os.fsync(out.fileno())
            seen.add(origin)
        return encode(Acknowledgement(duplicate=duplicate))

    with open_hub(endpoint) as hub:
        _server = QueryServer(hub, key, receive)
        print("up", flush=True)
        time.sleep(120)


if __name__ == "__main__":
    main(*sys.argv[1:])
