"""An actor without a simulator, for tests: real messages at full rate, and a journal of what it has sent.

`python -m tests.sim_actor ENDPOINT NAME SPOOL JOURNAL`. The journal gets a line `made BOOT SEQ CRC` before an
episode goes to the spool and `kept BOOT SEQ` after; what was kept and is no longer in the spool was
acknowledged.
"""

from __future__ import annotations

import sys
import time
import uuid
import zlib
from pathlib import Path

import numpy as np

from common.access import LOCAL
from common.bus import Keys, Member, announce, ask_later
from common.contract import accept_contract, fetch_contract
from common.delivery import Sender, Spool
from common.errors import UsageError
from common.link import end_process, make_link, open_client
from common.messages import Candidate, Candidates, Outcome, TaskQuery, encode
from common.tasks import GeometricProperties
from common.telemetry import Reporter, exit_on_signals, start_logging, stop_on_signals
from common.weights import WeightsPuller
from tests.helpers import tiny_episode

SPOOL_BYTES = 2**20


def main(endpoint: str, name: str, spool: Path, journal: Path) -> None:
    """Sends until SIGTERM."""
    start_logging()
    exit_on_signals()
    boot, member = uuid.uuid4().hex[:12], Member("actor", LOCAL, name)
    rng = np.random.default_rng(list(name.encode()))
    with open_client(make_link(endpoint)) as session, journal.open("a", buffering=1) as lines:
        contract = fetch_contract(session)
        config, keys = accept_contract(contract), Keys(contract.run)
        while True:
            try:
                token = announce(session, keys, member)
                break
            except UsageError:  # the token of a life that was cut off lasts until the lease ends
                time.sleep(0.5)
        weights = WeightsPuller(session, keys, "policy")
        reporter = Reporter(session, keys, member)
        episodes = Sender(session, Spool(spool / "learner", SPOOL_BYTES), member, boot)
        reports = Sender(session, Spool(spool / "curriculum", SPOOL_BYTES), member, boot, timeout=5.0)
        seq = full = answered = 0

        def count(answer: bytes | Exception) -> None:
            nonlocal answered
            answered += isinstance(answer, bytes)

        stopping = stop_on_signals()
        try:
            while not stopping.is_set():
                if episodes.spool.full or episodes.held_back:
                    full += episodes.spool.full
                    time.sleep(0.01)
                else:
                    steps = int(rng.integers(1, config.world.max_episode_steps))
                    episode = tiny_episode(config, steps, seq, digest=contract.digest)
                    payload = encode(episode)
                    lines.write(f"made {boot} {seq} {zlib.crc32(payload)}\n")
                    episodes.put(keys.trajectory, episode)
                    lines.write(f"kept {boot} {seq}\n")
                    seq += 1
                    task = episode.task
                    if seq % 4 == 0:
                        ask_later(session, keys.task, encode(TaskQuery(cell=task.cell)), count, 2.0)
                        if not reports.spool.full:
                            numbers = dict.fromkeys(GeometricProperties.model_fields, 0.5)
                            reports.put(
                                keys.result,
                                Outcome(
                                    digest=contract.digest,
                                    proposal=f"{name}-{boot}-{seq}",
                                    task=task,
                                    properties=GeometricProperties(**numbers),
                                    q=None,
                                    success=True,
                                    category="random",
                                ),
                            )
                            row = Candidate(task=task, visual=episode.visual[0], lidar=episode.lidar[0])
                            reports.put(keys.candidates, Candidates(digest=contract.digest, candidates=[row]))
                if reporter.due:
                    reporter.report(
                        {
                            "acknowledged": episodes.sent,
                            "reported": reports.sent,
                            "refused": sum((episodes.refused + reports.refused).values()),
                            "full": full,
                            "answered": answered,
                            "weights": weights.newest[0].counter if weights.newest else 0,
                        }
                    )
        finally:
            episodes.close(patience=0.5)
            reports.close(patience=0.1)
            token.undeclare()


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], Path(sys.argv[3]), Path(sys.argv[4]))
    end_process(0)
