"""`bench curriculum`: how long a task takes, beside a learner that updates, and with many actors asking.

Real processes: a learner that updates without a pause, a curriculum that joined it and has its critic, a full
database. One client asks, one question after the other; in turns with it the same client asks a process that
answers at once, which is the limit. Then many actors ask and report at the rate of a real one each. At last
the curriculum is killed and started again.
"""

from __future__ import annotations

import os
import queue
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path

import numpy as np
import zenoh

from common.access import LOCAL
from common.bus import Keys, Member, ask, ask_bytes, ask_later
from common.cells import CELLS
from common.config import Config, override
from common.delivery import Sender, Spool
from common.errors import RunError
from common.link import make_link, open_client
from common.members import Members
from common.messages import (
    Candidate,
    Candidates,
    Nothing,
    Outcome,
    Proposal,
    Proposals,
    Snapshot,
    TaskQuery,
    decode,
    encode,
)
from common.observation import ObservationLayout
from common.tasks import candidate_task
from deploy.bench.processes import PATIENCE, look_after, running, running_learner
from deploy.bench.replay import synthetic_episode
from deploy.bench.report import Report
from deploy.launcher import Child, free_port

RUN = "bench"
BARE = "bench/bare"
UPDATING = ("replay.samples_per_insert=1e9", "replay.error_buffer=1e12", "curriculum.gate.enabled=false")
"""Updates without a pause from few episodes; no gate, which needs neither f_pi nor Q."""
EPISODES, STEPS = 150, 22
BATCH = 40
"""Candidates of a message, as actors send them."""
WINDOW = 1.0
"""Seconds of one way of asking in a round."""
EPISODES_PER_S = 5.0
"""Of an actor process with nine worlds, of which each begins with a question and ends with a report."""
MEMBER = Member("actor", LOCAL, "bench")


def bench_curriculum(
    config: Config, rounds: int, actors: int, progress: Callable[[int, str], None]
) -> Report:
    """So many rounds of two windows alone and one with so many actors."""
    report, rng = Report("curriculum"), np.random.default_rng(config.seed)
    config = override(config.model_dump(mode="json"), UPDATING)
    ours, limit, crowd = (list[float]() for _ in range(3))
    ours_each, limit_each, spent = list[float](), list[float](), 0.0
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder, endpoint = Path(name), f"tcp/127.0.0.1:{free_port()}"
        (folder / "config.toml").write_text(config.to_toml(), "utf-8")
        progress(0, "the learner starts")
        run = folder / RUN
        _, contract = stack.enter_context(running_learner(run, folder / "config.toml", endpoint))
        serve = ["curriculum", "serve", "--run", str(run), "--connect", endpoint]
        child = stack.enter_context(running("curriculum", serve, folder / "curriculum.log"))
        stack.enter_context(_echo(endpoint))
        session = stack.enter_context(open_client(make_link(endpoint), look_after(child)))
        keys, members = Keys(RUN), Members(session, Keys(RUN))
        sender = Sender(session, Spool(folder / "spool", float("inf")), MEMBER, "bench", PATIENCE)
        stack.callback(partial(sender.close, 0.0))
        _fill(sender, keys, config, contract.digest, rng, partial(progress, 0))
        _wait(lambda: int(members.learner.get("updates", 0)) > 100, "the learner does not update")
        _wait(lambda: _ask(session, keys, rng).q is not None, "the curriculum has no critic")
        actors_ask = _Crowd(session, keys, sender, contract.digest, actors)
        updates, began = int(members.learner["updates"]), time.monotonic()
        for i in range(rounds):
            for times, each, question in (
                (limit, limit_each, partial(ask_bytes, session, BARE, b"")),
                (ours, ours_each, partial(_ask, session, keys, rng)),
            ):
                window = _time(question)
                times += window
                each.append(float(np.mean(window)))
            before = _cpu(child)
            crowd += actors_ask(rng)
            spent += _cpu(child) - before
            progress(i + 1, "")
        updated = (int(members.learner["updates"]) - updates) / (time.monotonic() - began)
        away, lost = _kill(child, partial(ask, session, keys.snapshot, Nothing(), Snapshot, 1.0, PATIENCE))
    for label, times in (("query", ours), ("bare_query", limit), (f"actors_{actors}", crowd)):
        for percent, value in zip((50, 99), np.percentile(times, (50, 99)), strict=True):
            report.add(f"{label}_p{percent}_ms", 1000 * float(value), "ms")
    report.add("queries_per_s", len(ours) / sum(ours), "1/s")
    report.add("bare_queries_per_s", len(limit) / sum(limit), "1/s")
    report.add(f"actors_{actors}_asked_per_s", len(crowd) / (rounds * WINDOW), "1/s")
    report.add(f"actors_{actors}_unanswered", actors_ask.unanswered, "questions")
    report.add(f"actors_{actors}_cpu_per_episode", 1000 * spent / len(crowd), "ms")
    report.add("learner_updates_per_s", updated, "1/s")
    report.add("restart_after_kill", away, "s")
    report.add("outcomes_lost_by_kill", lost, "outcomes")
    report.compare("query_over_bare_query", limit_each, ours_each)
    return report


def _wait(ready: Callable[[], bool], else_say: str) -> None:
    deadline = time.monotonic() + PATIENCE
    while not ready():
        if time.monotonic() > deadline:
            raise RunError(else_say)
        time.sleep(0.05)


def _fill(
    sender: Sender,
    keys: Keys,
    config: Config,
    digest: dict[str, str],
    rng: np.random.Generator,
    note: Callable[[str], None],
) -> None:
    """Episodes for the learner, and as many candidates for the curriculum as its database holds."""
    for _ in range(EPISODES):
        episode = synthetic_episode(config, STEPS, rng).model_copy(update={"digest": digest})
        sender.put(keys.trajectory, episode)
    layout = ObservationLayout.of(config)
    for done in range(0, config.curriculum.store_per_cell, BATCH):
        for cell in range(len(CELLS)):
            candidates = [
                Candidate(
                    task=candidate_task(cell, config, rng),
                    visual=(100 * rng.random(layout.row_shape)).astype(layout.row_dtype),
                    lidar=rng.random(layout.lidar).astype(np.float16),
                )
                for _ in range(BATCH)
            ]
            sender.put(keys.candidates, Candidates(digest=digest, candidates=candidates))
        _drain(sender)
        note(f"database: {done + BATCH} candidates of {config.curriculum.store_per_cell} in each cell")


def _drain(sender: Sender) -> None:
    """Waits until all is delivered."""
    deadline = time.monotonic() + PATIENCE
    while len(sender.spool):
        if sender.refused or time.monotonic() > deadline:
            raise RunError(f"the curriculum does not take it: {sender.last_refusal or sender.trouble}")
        time.sleep(0.01)


def _cpu(child: Child) -> float:
    """Seconds of processor that a process has had."""
    assert child.process is not None
    fields = Path(f"/proc/{child.process.pid}/stat").read_text("ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _kill(child: Child, ask_state: Callable[[], Snapshot]) -> tuple[float, int]:
    """Seconds from the start of a killed curriculum's successor to its first answer, and what it forgot."""
    known = ask_state().outcomes
    assert child.process is not None
    child.process.kill()
    child.process.wait()
    began = time.monotonic()
    child.start()
    found = ask_state().outcomes
    return time.monotonic() - began, known - found


def _ask(session: zenoh.Session, keys: Keys, rng: np.random.Generator) -> Proposal:
    """A task for some cell, asked late in a run, when some are random."""
    query = TaskQuery(cell=int(rng.integers(len(CELLS))), t=100_000)
    return ask(session, keys.task, query, Proposals, PATIENCE).tasks[0]


def _time(question: Callable[[], object]) -> list[float]:
    """Seconds that each answer takes, one after the other for a window."""
    times, until = list[float](), time.perf_counter() + WINDOW
    while (began := time.perf_counter()) < until:
        question()
        times.append(time.perf_counter() - began)
    return times


class _Crowd:
    """Many actors, each with a question at random moments and a report of what became of the task."""

    def __init__(
        self, session: zenoh.Session, keys: Keys, sender: Sender, digest: dict[str, str], actors: int
    ) -> None:
        self._session, self._keys, self._sender, self._digest = session, keys, sender, digest
        self._rate = actors * EPISODES_PER_S
        self.unanswered = 0

    def __call__(self, rng: np.random.Generator) -> list[float]:
        """Seconds that each of a window's answers took."""
        answers: queue.SimpleQueue[tuple[float, bytes | Exception]] = queue.SimpleQueue()
        moments = np.sort(rng.uniform(0, WINDOW, rng.poisson(self._rate * WINDOW)))
        times, began = list[float](), time.perf_counter()

        def hear(asked: float, answer: bytes | Exception) -> None:
            answers.put((time.perf_counter() - asked, answer))

        def take(patience: float) -> None:
            with suppress(queue.Empty):
                taken, answer = answers.get(timeout=patience)
                times.append(taken)
                self._report(answer, rng)

        for moment in moments:
            while (left := began + moment - time.perf_counter()) > 0:
                take(left)
            question = encode(TaskQuery(cell=int(rng.integers(len(CELLS))), t=100_000))
            asked = partial(hear, time.perf_counter())
            ask_later(self._session, self._keys.task, question, asked, PATIENCE, urgent=True)
        while len(times) < len(moments):
            take(2 * PATIENCE)
        _drain(self._sender)  # what is measured next must not share the service with reports
        return times

    def _report(self, answer: bytes | Exception, rng: np.random.Generator) -> None:
        if isinstance(answer, Exception):
            self.unanswered += 1
            return
        task = decode(Proposals, answer).tasks[0]
        success = bool(rng.random() < 0.5)
        outcome = Outcome(digest=self._digest, proposal=task.id, task=task.task, success=success)
        self._sender.put(self._keys.result, outcome)


@contextmanager
def _echo(endpoint: str) -> Iterator[None]:
    """A process that answers BARE with nothing, at once."""
    command = [sys.executable, "-m", "deploy.bench.curriculum", endpoint]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        try:
            if not process.stdout.readline():
                raise RunError(f"a process of the benchmark ended with {process.wait()}")
            yield
        except BaseException:
            process.kill()
            raise


def _answer_bare(endpoint: str) -> None:
    with open_client(make_link(endpoint), patience=PATIENCE) as session:

        def answer(query: zenoh.Query) -> None:
            with query:
                query.reply(BARE, b"")

        _queryable = session.declare_queryable(BARE, answer)
        print("up", flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    _answer_bare(sys.argv[1])
