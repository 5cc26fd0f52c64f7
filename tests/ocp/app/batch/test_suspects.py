"""Tasks that end their workers are found among those that run beside them, whatever the order."""

from __future__ import annotations

import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

from hypothesis import given, settings
from hypothesis import strategies as st

from ocp.app.batch.engine import Engine, EngineSettings, Job, Outcome, PendingTasks
from ocp.app.batch.result_store import Payload, ResultStore


class ScriptedEngine:
    """Engine without processes: a deadly task ends its worker, and all tasks that were sent are lost with it."""

    def __init__(self, deadly: set[str], slots: int, deaths: int) -> None:
        self.deadly, self.slots, self.settings = deadly, slots, EngineSettings(deaths=deaths)
        self.sent: list[Job] = []
        self.ended = 0

    @property
    def is_idle(self) -> bool:
        return not self.sent

    def free_slots(self) -> int:
        return self.slots - len(self.sent)

    def submit(self, job: Job) -> None:
        assert len(self.sent) < self.slots
        self.sent.append(job)

    def wait(self, seconds: float) -> list[Outcome]:
        assert self.sent, "it waits for nothing"
        jobs, self.sent = self.sent, []
        if any(job.key in self.deadly for job in jobs):
            self.ended += 1
            assert self.ended <= len(self.deadly) * (self.settings.deaths + self.slots)
            return [Outcome(job.key, None, 1) for job in jobs]
        timing = {"seconds": 0.0, "inputs": {"kept": {}}}
        fields: dict[str, Any] = {
            "status": "done",
            "error": "",
            "message": "",
            "cost": None,
            "verdict": None,
            "files": [],
        }
        return [Outcome(job.key, Payload({**fields, "value": json.loads(job.task), **timing})) for job in jobs]


@settings(max_examples=40, deadline=None)
@given(st.data(), st.integers(1, 12), st.integers(1, 4), st.integers(1, 4))
def test_exactly_the_deadly_tasks_are_given_up(data: Any, count: int, slots: int, deaths: int) -> None:
    keys = [f"{k:064x}" for k in range(count)]
    deadly = data.draw(st.sets(st.sampled_from(keys)))
    parents: dict[str, str | None] = {key: data.draw(st.sampled_from([None, *keys[:k]])) for k, key in enumerate(keys)}
    engine = ScriptedEngine(deadly, slots, deaths)
    with TemporaryDirectory() as folder:
        store = ResultStore.of(Path(folder) / "batch", "square", "1", True)
        texts = {key: json.dumps(k) for k, key in enumerate(keys)}
        pending = PendingTasks(store, texts, parents, results={}, source="")
        pending.run(cast("Engine", engine))
        status = {key: result.status for key, result in pending.results.items()}
    assert status == {key: "killed" if key in deadly else "done" for key in keys}
    assert pending.failures == len(deadly)
