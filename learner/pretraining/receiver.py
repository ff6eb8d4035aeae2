"""The receiving end of a pre-training on the bus: serves the contract and takes frames in."""

from __future__ import annotations

import zenoh

from common.bus import BUSY, Keys, serve
from common.contract import check_digest, digest
from common.delivery import Parcel, Receiver
from common.messages import ContractReply, Frames, Message, MessageError, Nothing, decode
from learner.pretraining.frame_store import FrameStore


class FrameReceiver:
    """Takes drives from actors into a store, each acknowledged when it is on disk, until closed."""

    def __init__(self, session: zenoh.Session, name: str, store: FrameStore) -> None:
        self._store, config = store, store.config
        self.failure: OSError | None = None
        """Why the store could not be written to."""
        self.contract = ContractReply(
            run=name, config=config.to_toml(), encoder=b"", digest=digest(config, b""), job="pretraining"
        )
        keys = Keys(name)
        self._servers = [
            Receiver(session, keys.frames, self._take, store.seen, Frames.max_bytes),
            serve(session, keys.contract, Nothing, self._answer_contract),
        ]

    def _take(self, parcel: Parcel) -> None:
        message = decode(Frames, parcel.payload)
        check_digest(self.contract.digest, message.digest)
        try:
            self._store.add(parcel, message)
        except OSError as error:
            self.failure = error
            raise MessageError(BUSY) from None  # the sender keeps it, should there be a next time

    def _answer_contract(self, question: Message) -> ContractReply:
        return self.contract

    def close(self) -> None:
        """Stops taking."""
        for server in self._servers:
            server.close()
