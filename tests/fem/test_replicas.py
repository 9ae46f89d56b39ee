"""Several finite-element services under one key: any may answer, and none answers otherwise."""

from __future__ import annotations

import contextlib
import importlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from palpate.bus import Session
from palpate.bus.topics import duty_root
from palpate.client import Client
from palpate.config import LinkConfig, parse_config
from palpate.errors import LinkError, PalpateError, RemoteError
from palpate.messages import ServiceState, SimulationOutcome, SimulationReply
from palpate_fem.mesh.nvlabs import PARTS, SKIN
from palpate_fem.service import node
from palpate_fem.service.config import FemConfig

fakes: Any = importlib.import_module("fem_fakes")

PATIENCE_S = 60.0
FAKES = {"factory": "fem_fakes:make", "workers": 1, "waiting": 0, "grace_s": 0.3, "threads": 1}
STEPS = 40

CHILD = """
import sys, threading
from palpate.config import LinkConfig, parse_config
from palpate_fem.service import node
from palpate_fem.service.config import FemConfig
endpoint, instance = sys.argv[1:]
values = {"factory": "fem_fakes:make", "workers": 1, "waiting": 0, "grace_s": 0.3, "threads": 1}
config = parse_config(FemConfig, values, where="test")
node.run(config, LinkConfig(connect=(endpoint,)), "lab", threading.Event(), instance=instance)
"""


def until(true: Callable[[], Any]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not true():
        assert time.monotonic() < deadline, "it did not become true in time"
        time.sleep(0.05)


def holders(session: Session) -> list[str]:
    return [one.instance for one in session.holders(duty_root("simulate"), "twin")]


def held_by_any(session: Session) -> list[Any]:
    return session.holders(duty_root("simulate"), "*")


@contextlib.contextmanager
def child(link: LinkConfig, instance: str) -> Iterator[subprocess.Popen[bytes]]:
    """A replica in a process of its own, which can be killed and stopped."""
    process = subprocess.Popen(
        [sys.executable, "-c", CHILD, link.connect[0], instance], start_new_session=True
    )
    try:
        with Session.open(link) as session:
            until(lambda: instance in holders(session))
            until(lambda: any(a.instance == instance and a.ready for a in session.alive()))
        yield process
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


@contextlib.contextmanager
def thread(link: LinkConfig, instance: str, **values: Any) -> Iterator[None]:
    stop = threading.Event()
    config = parse_config(FemConfig, {**FAKES, **values}, where="test")
    running = threading.Thread(
        target=node.run, args=(config, link, "lab", stop), kwargs={"instance": instance}
    )
    running.start()
    try:
        yield
    finally:
        stop.set()
        running.join(PATIENCE_S)
    assert not running.is_alive()


class Asked:
    """A simulation of many slow steps, in a thread."""

    def __init__(self, robot: Client, name: str) -> None:
        self.steps: list[int] = []
        self.answer: list[SimulationReply | PalpateError] = []
        self.begun = threading.Event()
        self._request = fakes.request(name, fakes.SLOW, steps=STEPS)
        self._robot = robot
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        try:
            reply = self._robot.simulate(
                self._request,
                timeout_s=PATIENCE_S,
                on_step=lambda number, _: self._step(number),
            )
        except PalpateError as error:
            self.answer.append(error)
        else:
            self.answer.append(reply)

    def _step(self, number: int) -> None:
        self.steps.append(number)
        self.begun.set()

    def wait(self) -> SimulationReply | PalpateError:
        self._thread.join(3 * PATIENCE_S)
        return self.answer[0]


def busy(robot: Client, instance: str) -> bool:
    return any(
        one.instance == instance and one.gauges.get("busy_workers", 0.0) > 0
        for one in robot.status()
    )


@contextlib.contextmanager
def two_with_a_question(bus: LinkConfig) -> Iterator[tuple[int, Client, Asked]]:
    """Two replicas and a question: the process id of that which works on it, its caller, and it."""
    with contextlib.ExitStack() as stack:
        replicas = {name: stack.enter_context(child(bus, name)) for name in ("fem-a", "fem-b")}
        robot = stack.enter_context(Client(bus.connect[0], timeout_s=10))
        asked = Asked(robot, "failover")
        assert asked.begun.wait(PATIENCE_S)
        until(lambda: any(busy(robot, name) for name in replicas))
        (victim,) = (name for name in replicas if busy(robot, name))
        yield replicas[victim].pid, robot, asked


@pytest.mark.parametrize("fault", [signal.SIGKILL, signal.SIGSTOP])
def test_what_one_does_not_finish_another_does(own_bus: LinkConfig, fault: signal.Signals) -> None:
    """The caller sees each step once, and a whole answer."""
    with two_with_a_question(own_bus) as (victim, robot, asked):
        # Its workers go with it: it is the process that is lost, or the whole host that stops.
        os.killpg(victim, fault)
        reply = asked.wait()
        assert isinstance(reply, SimulationReply), reply
        assert reply.outcome is SimulationOutcome.COMPLETE
        assert asked.steps == list(range(STEPS))
        # The next question does not go to the one that is gone.
        began_s = time.monotonic()
        again = robot.simulate(fakes.request("next"), timeout_s=PATIENCE_S)
        assert again.outcome is SimulationOutcome.COMPLETE
        assert time.monotonic() - began_s < PATIENCE_S
        if fault == signal.SIGSTOP:
            os.killpg(victim, signal.SIGCONT)


def test_another_whose_link_comes_back_takes_over(
    own_bus: LinkConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    with two_with_a_question(own_bus) as (victim, _, asked):
        known = Session.holders
        looks: list[object] = []

        def holders(session: Session, *of: str) -> object:
            looks.append(of)
            return known(session, *of) if len(looks) > 3 else ()

        monkeypatch.setattr(Session, "holders", holders)
        os.killpg(victim, signal.SIGKILL)
        reply = asked.wait()
        assert isinstance(reply, SimulationReply), reply
        assert len(looks) > 3
        assert asked.steps == list(range(STEPS))


def test_the_last_one_that_dies_ends_the_question_with_a_typed_error(own_bus: LinkConfig) -> None:
    with contextlib.ExitStack() as stack:
        replica = stack.enter_context(child(own_bus, "fem-a"))
        robot = stack.enter_context(Client(own_bus.connect[0], timeout_s=10))
        asked = Asked(robot, "lonely")
        assert asked.begun.wait(PATIENCE_S)
        os.killpg(replica.pid, signal.SIGKILL)
        assert isinstance(asked.wait(), PalpateError)
        with pytest.raises(LinkError):
            robot.simulate(fakes.request("nobody"), timeout_s=10.0)


def test_one_that_is_full_is_not_the_last_that_is_asked(own_bus: LinkConfig) -> None:
    """Two with one worker each and no queue take two at once; a third is refused by both."""
    with (
        thread(own_bus, "fem-a"),
        thread(own_bus, "fem-b"),
        Client(own_bus.connect[0], timeout_s=10) as robot,
    ):
        until(lambda: holders(robot.session) == ["fem-a", "fem-b"])
        until(lambda: sum(a.service == "fem" and a.ready for a in robot.alive()) == 2)
        first = Asked(robot, "first")
        assert first.begun.wait(PATIENCE_S), first.answer
        second = Asked(robot, "second")
        assert second.begun.wait(PATIENCE_S), (second.answer, robot.status())
        with pytest.raises(RemoteError, match="wait"):
            robot.simulate(fakes.request("third"), timeout_s=10.0)
        for name in ("first", "second"):  # whichever of the two computes it
            assert robot.cancel_simulation(name)
        assert not robot.cancel_simulation("never asked")
        for asked in (first, second):
            reply = asked.wait()
            assert isinstance(reply, SimulationReply)
            assert reply.outcome is SimulationOutcome.CANCELLED


def test_a_replica_with_other_parameters_does_not_answer(own_bus: LinkConfig) -> None:
    with (
        Client(own_bus.connect[0], timeout_s=10) as robot,
        contextlib.ExitStack() as first,
        contextlib.ExitStack() as second,
    ):
        first.enter_context(thread(own_bus, "fem-a"))
        until(lambda: holders(robot.session) == ["fem-a"])
        until(lambda: any(a.instance == "fem-a" and a.ready for a in robot.alive()))
        second.enter_context(thread(own_bus, "fem-b", fingertip={"shear_modulus_pa": 3.0e5}))

        def other() -> Any:
            return next((one for one in robot.status() if one.instance == "fem-b"), None)

        until(lambda: (found := other()) and found.state is ServiceState.DEGRADED)
        assert "would answer otherwise" in other().last_error.message
        for number in range(5):
            robot.simulate(fakes.request(f"asked {number}"), timeout_s=PATIENCE_S)
        assert holders(robot.session) == ["fem-a"]
        assert not other().counters.get("requests_received")
        # It takes the key when nobody else answers there.
        first.close()
        until(lambda: holders(robot.session) == ["fem-b"])
        until(lambda: (found := other()) and found.state is ServiceState.READY)
        robot.simulate(fakes.request("the other"), timeout_s=PATIENCE_S)
        assert other().counters.get("requests_received") == 1


def test_options_at_their_defaults_are_no_difference(own_bus: LinkConfig) -> None:
    with (
        thread(own_bus, "fem-a"),
        thread(own_bus, "fem-b", options={"fill_s": 0.0}),
        Client(own_bus.connect[0], timeout_s=10) as robot,
    ):
        until(lambda: holders(robot.session) == ["fem-a", "fem-b"])


def test_who_may_not_answer_says_so_once(own_bus: LinkConfig) -> None:
    stop = threading.Event()
    told: list[PalpateError] = []
    values = {**FAKES, "fingertip": {"shear_modulus_pa": 3.0e5}}
    with (
        thread(own_bus, "fem-a"),
        Client(own_bus.connect[0], timeout_s=10) as robot,
    ):
        until(lambda: holders(robot.session) == ["fem-a"])
        other = threading.Thread(
            target=node.run,
            args=(parse_config(FemConfig, values, where="test"), own_bus, "lab", stop),
            kwargs={"instance": "fem-b", "on_refusal": told.append},
        )
        other.start()
        try:
            until(lambda: told)
            until(lambda: any(one.state is ServiceState.DEGRADED for one in robot.status()))
        finally:
            stop.set()
            other.join(PATIENCE_S)
    (refusal,) = told
    assert "would answer otherwise" in refusal.problem


def test_services_of_one_name_answer_for_their_own_sensors(own_bus: LinkConfig) -> None:
    round_finger = {"factory": "fem_fakes:round_finger", "waiting": 2}
    with (
        thread(own_bus, "fem", sensor="soft", fingertip={"shear_modulus_pa": 1e5}, **round_finger),
        thread(own_bus, "fem", sensor="hard", fingertip={"shear_modulus_pa": 1e6}, **round_finger),
        Client(own_bus.connect[0], timeout_s=10) as robot,
    ):
        until(lambda: {one.sensor for one in held_by_any(robot.session)} == {"soft", "hard"})
        for number in range(5):
            force = {
                sensor: robot.simulate(
                    fakes.request(f"{sensor} {number}"), sensor=sensor, timeout_s=PATIENCE_S
                )
                .steps[-1]
                .force[2]
                for sensor in ("soft", "hard")
            }
            assert force["hard"] == pytest.approx(10.0 * force["soft"])


def test_many_may_ask_in_the_same_instant(
    own_bus: LinkConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More than a queue of the bus holds by itself: as many as may run and wait."""
    values = {"waiting": 20, "workers": 3, "slots": 1}
    count, held = 23, threading.Event()
    answer = node.SimulationService.simulate

    def slow(self: Any, *arguments: Any) -> None:
        held.wait(PATIENCE_S)
        answer(self, *arguments)

    monkeypatch.setattr(node.SimulationService, "simulate", slow)
    ends: list[str] = []

    def ask(client: Client, number: int) -> None:
        try:
            reply = client.simulate(fakes.request(f"{number}", steps=1), timeout_s=PATIENCE_S)
            ends.append(reply.outcome.name)
        except PalpateError as error:
            ends.append(str(error))

    with thread(own_bus, "one", **values), Client(own_bus.connect[0], timeout_s=20) as robot:
        until(lambda: [one.gauges.get("ready_workers") for one in robot.status()] == [3])
        threads = [threading.Thread(target=ask, args=(robot, k)) for k in range(count)]
        for each in threads:
            each.start()
        time.sleep(2.0)
        assert ends == [], "none is refused"
        held.set()
        for each in threads:
            each.join(PATIENCE_S)
    assert ends == ["COMPLETE"] * count


def test_replicas_with_a_mesh_of_files_are_compared_by_the_files(tmp_path: Path) -> None:
    """Two hosts may have them in other folders, or other ones in folders of one name."""
    digests = []
    for name, content in (("here", "a"), ("there", "a"), ("there", "b")):
        for file in (SKIN, PARTS):
            (tmp_path / name / file).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name / file).write_text(content)
        values = {"options": {"mesh": str(tmp_path / name)}}
        digests.append(node.answers_digest(parse_config(FemConfig, values, where="test")))
    assert digests[0] == digests[1] != digests[2]
