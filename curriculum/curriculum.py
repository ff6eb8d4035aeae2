"""The curriculum's state: what to propose, given the outcomes and candidates so far. Free of the bus."""

from __future__ import annotations

import json
import uuid
from collections import Counter, deque
from pathlib import Path

import numpy as np

from common.config import Config
from common.delivery import DuplicateFilter
from common.errors import UsageError
from common.messages import Candidates, Category, Outcome, Proposal, Requested
from common.policy_files import finish_saving, load_tensors, save_folder
from common.tasks import Task, candidate_task, random_task
from common.world_config import StartRanges
from curriculum.adaptive_filtering import fit_normal, get_anchored_task, get_dynamic_task, get_task_type
from curriculum.success_network import SuccessNetwork
from curriculum.task_store import CriticView, Entry, TaskStore


class Gate:
    """Favourable starts until they succeed (section 5.3): open for good once enough of the last ones did."""

    def __init__(self, config: Config) -> None:
        self.config = config.curriculum.gate
        self.ranges = StartRanges(**self.config.ranges.model_dump())
        self.open = not self.config.enabled
        self.outcomes: deque[bool] = deque(maxlen=self.config.window)

    def add(self, success: bool) -> None:
        """Takes the outcome of a favourable start."""
        self.outcomes.append(success)
        if len(self.outcomes) == self.config.window:
            self.open = self.open or sum(self.outcomes) >= self.config.threshold * self.config.window


class Curriculum:
    """Gate, f_pi, task database and critic behind `propose`, `report`, `add`, `save`, `restore`."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.rng = np.random.default_rng([config.seed, 3])
        self.network = SuccessNetwork(config.curriculum, config.seed)
        self.store = TaskStore(config)
        self.critic = CriticView(config)
        self.gate = Gate(config)
        self.proposed: Counter[str] = Counter()
        self.outcomes = 0
        self.seen = DuplicateFilter()

    def propose(self, cell: int, t: int) -> Proposal:
        """A task for a cell, asked at the agent's own step t (algorithm 2)."""
        requested = get_task_type(t, self.config.curriculum, self.rng)
        if self.config.curriculum.algorithm == "rnd":
            return self._proposal(self._new(random_task(cell, self.config, self.rng)), "random", "rnd")
        if not self.gate.open:
            task = random_task(cell, self.config, self.rng)
            near = task.model_copy(update={"start": self.gate.ranges})
            return self._proposal(self._new(near), requested, "gate")
        return self._filter(cell, requested)

    def report(self, outcome: Outcome) -> None:
        """Takes the outcome of a proposed task."""
        self.outcomes += 1
        if outcome.category == "gate":
            self.gate.add(outcome.success)
        if self.config.curriculum.algorithm != "rnd":
            self.network.add(outcome.properties, outcome.q, outcome.success)

    def add(self, message: Candidates) -> None:
        """Takes candidate starts into the database."""
        self.store.add(message.candidates)

    def _filter(self, cell: int, requested: Requested) -> Proposal:
        """Adaptive filtering over candidates of the cell: fit, then draw until one meets the request."""
        config = self.config.curriculum
        sample = self._draw(cell, config.filter_samples)
        mu, sigma = fit_normal(self._predict(sample))
        # an empty database is made up for by geometry, too slow to do twice
        draws = self._draw(cell, config.max_draws) if self.store.count(cell) else sample
        f = self._predict(draws)
        if self.network.plus:
            found = get_anchored_task(requested, f, mu, sigma, config, self.rng)
        else:
            found = get_dynamic_task(requested, f.tolist(), mu, sigma, config)
        category: Category = requested if found is not None else "random"
        index = int(self.rng.integers(len(draws))) if found is None else found
        self.store.remove(draws[index])
        return self._proposal(draws[index], requested, category, float(f[index]), mu, sigma)

    def _draw(self, cell: int, count: int) -> list[Entry]:
        """RandomTask, `count` times: from the cell's database, or by geometry alone while that is empty."""
        entries = self.store.sample(cell, count, self.rng)
        if entries:
            self.critic.refresh(entries)
            return entries
        return [self._new(candidate_task(cell, self.config, self.rng)) for _ in range(count)]

    def _new(self, task: Task) -> Entry:
        return self.store.make_entry(task)

    def _predict(self, entries: list[Entry]) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        f = self.network.predict([e.properties for e in entries], [e.q for e in entries])
        return np.asarray(f)

    def _proposal(
        self,
        entry: Entry,
        requested: Requested,
        category: Category,
        f: float | None = None,
        mu: float | None = None,
        sigma: float | None = None,
    ) -> Proposal:
        self.proposed[category] += 1
        if f is None:
            reason = f"not used by {category}"
        elif entry.q is not None:
            reason = "critic"
        elif entry.observed is None:
            reason = "no candidate in the database; by geometry alone"
        else:
            reason = "no critic yet"
        robot, dolly = entry.scene.robot, entry.scene.dolly
        return Proposal(
            id=uuid.uuid4().hex,
            task=entry.task,
            requested=requested,
            category=category,
            properties=entry.properties,
            q=entry.q,
            q_reason=reason,
            f=f,
            mu=mu,
            sigma=sigma,
            robot=(robot.x, robot.y, robot.yaw),
            dolly=(dolly.x, dolly.y, dolly.yaw),
        )

    def save(self, folder: Path) -> None:
        """Writes f_pi, its outcomes and the gate; candidates are refilled by the actors."""
        tensors, numbers = self.network.state()
        state = {
            "numbers": numbers,
            "gate_open": self.gate.open,
            "gate_outcomes": list(self.gate.outcomes),
            "outcomes": self.outcomes,
            "seen": self.seen.state(),
            "proposed": self.proposed,
        }
        texts = {"state.json": json.dumps(state), "config.toml": self.config.to_toml()}
        save_folder(folder, texts, {"success_network.safetensors": tensors})

    def restore(self, folder: Path) -> None:
        """Takes what `save` wrote, if it is there; raises UsageError when it does not fit."""
        finish_saving(folder.parent)
        if not (folder / "state.json").exists():
            return
        try:
            state = json.loads((folder / "state.json").read_text("utf-8"))
            tensors = load_tensors(folder / "success_network.safetensors")
            self.network.restore(tensors, state["numbers"])
            self.gate.open = bool(state["gate_open"])
            self.gate.outcomes.extend(state["gate_outcomes"])
            self.seen.restore(state.get("seen", []))
            self.outcomes, self.proposed = int(state["outcomes"]), Counter(state["proposed"])
        except (KeyError, ValueError, TypeError) as error:
            raise UsageError(
                f"curriculum state {folder} does not fit: {error}; remove it to start afresh"
            ) from None
