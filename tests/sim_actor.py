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
import zenoh

from common.access import LOCAL
from common.bus import Keys, Member, announce, ask_later
from common.contract import accept_contract, fetch_contract
from common.delivery import Sender, Spool
from common.errors import UsageError
from common.link import end_process, make_link, open_client
from common.messages import Candidate, Candidates, Episode, Outcome, TaskQuery, encode
from common.signals import exit_on_signals, stop_on_signals
from common.telemetry import Reporter, start_logging
from common.weights import WeightsPuller
from tests.helpers import tiny_episode

SPOOL_BYTES = 2**20


def outcome_and_candidate(episode: Episode, proposal: str) -> tuple[Outcome, Candidates]:
    """What an actor also reports, to the curriculum."""
    outcome = Outcome(digest=episode.digest, proposal=proposal, task=episode.task, success=True)
    row = Candidate(task=episode.task, visual=episode.visual[0], lidar=episode.lidar[0])
    return outcome, Candidates(digest=episode.digest, candidates=[row])


def announce_soon(session: zenoh.Session, keys: Keys, member: Member) -> zenoh.LivelinessToken:
    """Waits for the token of a former life, which lasts until the lease ends when that was cut off."""
    while True:
        try:
            return announce(session, keys, member)
        except UsageError:
            time.sleep(0.5)


def main(endpoint: str, name: str, spool: Path, journal: Path) -> None:
    """Sends until SIGTERM."""
    start_logging()
    exit_on_signals()
    boot, member = uuid.uuid4().hex[:12], Member("actor", LOCAL, name)
    rng = np.random.default_rng(list(name.encode()))
    with open_client(make_link(endpoint)) as session, journal.open("a", buffering=1) as lines:
        contract = fetch_contract(session)
        config, keys = accept_contract(contract), Keys(contract.run)
        token = announce_soon(session, keys, member)
        weights = WeightsPuller(session, keys, "policy")
        reporter = Reporter(session, keys, member)
        episodes = Sender(session, Spool(spool / "learner", SPOOL_BYTES), member, boot)
        reports = Sender(session, Spool(spool / "curriculum", SPOOL_BYTES), member, boot, timeout=5.0)
        seq = full = 0
        stopping = stop_on_signals()
        while not stopping.is_set():
            if reporter.due:
                reporter.report({"acknowledged": episodes.sent, "full": full})
            if episodes.spool.full or episodes.held_back:
                full += episodes.spool.full
                time.sleep(0.01)
                continue
            steps = int(rng.integers(1, config.world.max_episode_steps))
            episode = tiny_episode(config, steps, seq, digest=contract.digest)
            lines.write(f"made {boot} {seq} {zlib.crc32(encode(episode))}\n")
            episodes.put(keys.trajectory, episode)
            lines.write(f"kept {boot} {seq}\n")
            if seq % 4 == 0 and not reports.spool.full:
                question = encode(TaskQuery(cell=episode.task.cell))
                ask_later(session, keys.task, question, lambda answer: None, 2.0)
                outcome, candidates = outcome_and_candidate(episode, f"{name}-{boot}-{seq}")
                reports.put(keys.result, outcome)
                reports.put(keys.candidates, candidates)
            seq += 1
        episodes.close(patience=0.5)
        reports.close(patience=0.1)
        token.undeclare()
        del weights


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], Path(sys.argv[3]), Path(sys.argv[4]))
    end_process(0)
