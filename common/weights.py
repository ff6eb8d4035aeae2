"""Versioned weights on the wire: safetensors with a checksum that is verified before use.

torch, which takes seconds to load, is loaded with the first weights: who waits for them can answer meanwhile.
"""

from __future__ import annotations

import hashlib
import logging
import queue
import threading
import time
from typing import TYPE_CHECKING

import zenoh

from common.bus import Keys, Subscription, ask
from common.errors import NoAnswerError, RefusedError
from common.messages import MessageError, Nothing, Version, WeightsBlob
from common.telemetry import Quantiles

if TYPE_CHECKING:
    from torch import Tensor

log = logging.getLogger(__name__)


def pack(version: Version, tensors: dict[str, Tensor]) -> WeightsBlob:
    """Tensors as a message."""
    from safetensors.torch import save as save_tensors

    # safetensors refuses tensors that share memory, as those of a target network may
    blob = save_tensors({key: value.detach().clone().contiguous() for key, value in tensors.items()})
    return WeightsBlob(version=version, sha256=hashlib.sha256(blob).hexdigest(), blob=blob)


def unpack(message: WeightsBlob) -> dict[str, Tensor]:
    """The tensors; raises MessageError when the checksum or the format is wrong."""
    if hashlib.sha256(message.blob).hexdigest() != message.sha256:
        raise MessageError("weights are corrupted: the checksum does not match")
    from safetensors.torch import load as load_tensors

    try:
        return dict(load_tensors(message.blob))
    except Exception as error:  # safetensors raises its own class without exporting a common base
        raise MessageError(f"weights are not safetensors: {error}") from None


class WeightsPuller:
    """Keeps the newest weights of a kind at hand: hears of versions, pulls them from a thread of its own."""

    def __init__(self, session: zenoh.Session, keys: Keys, kind: str, rest: float = 0.0) -> None:
        """`rest` is the least time between two pulls, s."""
        self.newest: tuple[Version, dict[str, Tensor]] | None = None
        self.latency = Quantiles()
        self._session, self._key, self._rest = session, keys.weights(kind), rest
        self._heard: queue.SimpleQueue[Version] = queue.SimpleQueue()
        self._subscription = Subscription(session, keys.version, Version, self._heard.put)
        threading.Thread(target=self._run, name="weights", daemon=True).start()

    def _run(self) -> None:
        self._pull()  # a late joiner does not wait for the next version
        while True:
            version = self._heard.get()
            while not self._heard.empty():
                version = self._heard.get()
            if self.newest is None or self.newest[0] < version:
                self._pull()
            time.sleep(self._rest)

    def _pull(self) -> None:
        began = time.monotonic()
        try:
            blob = ask(self._session, self._key, Nothing(), WeightsBlob, timeout=10.0)
            self.newest = blob.version, unpack(blob)
            self.latency.add(1000 * (time.monotonic() - began))
        except (NoAnswerError, RefusedError, MessageError, zenoh.ZError) as error:
            log.info("no weights: %s", error)
