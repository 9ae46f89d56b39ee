"""Whatever one message says, it costs no more than itself; gaps, restarts and rivals are told."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpate.bus.continuity import SILENT_NS, Continuity, Holes
from palpate.messages import Origin, Stamp

PERIOD_NS = 10_000_000
BEGAN_NS = 10**15
U64 = st.integers(1, 2**63 - 1)
A, B, C = 0xA, 0xB, 0xC


class Source:
    """A continuity that gets messages at 100 Hz; a message is what its sender calls it."""

    def __init__(
        self,
        *,
        contiguous: bool = True,
        trusting: bool = False,
        held: set[int] | None = None,
    ) -> None:
        self.counters: Counter[str] = Counter()
        self.held = held
        self.got: list[str] = []
        self._at_ns = BEGAN_NS
        self._continuity: Continuity[str] = Continuity(
            self.counters,
            contiguous=contiguous,
            trusting=trusting,
            holders=lambda: None if self.held is None else frozenset(self.held),
        )

    def stamp(self, sequence: int, session: int = A, origin: Origin = Origin.LIVE) -> Stamp:
        return Stamp(sequence, sequence, self._at_ns, self._at_ns, 7, origin, 0, session)

    def send(
        self, name: str, stamp: Stamp, *, after_ns: int = PERIOD_NS, lost_here: int = 0
    ) -> None:
        """A message comes ``after_ns`` after the one before it."""
        self._at_ns += after_ns
        taken = self._continuity.take(
            name, stamp, serial="S", arrived_ns=self._at_ns, lost_here=lost_here
        )
        self.got.extend(taken)

    def run(self, first: int, last: int, session: int = A, name: str = "") -> None:
        for sequence in range(first, last + 1):
            self.send(f"{name}{sequence}", self.stamp(sequence, session))

    def wait(self, ns: int) -> None:
        self._at_ns += ns


def names(first: int, last: int, name: str = "") -> list[str]:
    return [f"{name}{sequence}" for sequence in range(first, last + 1)]


stamps = st.fixed_dictionaries(
    {},
    optional={
        "sequence": st.one_of(U64, st.integers(1, 60), st.integers(60, 2000)),
        "monotonic_ns": st.one_of(
            U64, st.integers(-400, 400_000).map(lambda periods: BEGAN_NS + periods * PERIOD_NS)
        ),
        "session_id": st.sampled_from([0, A, B]),
        "origin": st.sampled_from(Origin),
        "clock_id": st.integers(0, 2**32 - 1),
    },
)


@given(
    wrong=stamps,
    at=st.integers(1, 30),
    session=st.sampled_from([0, A]),
    contiguous=st.booleans(),
    origin=st.sampled_from(Origin),
)
def test_one_wrong_stamp_costs_one_message_at_most(
    wrong: dict[str, object], at: int, session: int, contiguous: bool, origin: Origin
) -> None:
    """A message whose stamp was damaged, in place of the right one, at any place in a stream."""
    source = Source(contiguous=contiguous)
    for sequence in range(1, 41):
        stamp = source.stamp(sequence, session, origin)
        if sequence == at:
            source.send("wrong", replace(stamp, **wrong))  # type: ignore[arg-type]
        else:
            source.send(str(sequence), stamp)
    good = [name for name in source.got if name != "wrong"]
    missing = [name for name in names(1, 40) if name not in good and name != str(at)]
    assert len(missing) <= 1, source.counters
    assert good == sorted(good, key=int), "and the others stay in order"
    assert source.got.count("wrong") <= 1


@given(wrong=stamps, at=st.integers(0, 30), session=st.sampled_from([0, A]))
def test_one_message_too_many_costs_one_message_at_most(
    wrong: dict[str, object], at: int, session: int
) -> None:
    """A strange message between the right ones, e.g. of somebody else."""
    source = Source()
    for sequence in range(1, 41):
        stamp = source.stamp(sequence, session)
        if sequence == at:
            source.send("wrong", replace(stamp, **wrong), after_ns=0)  # type: ignore[arg-type]
        source.send(str(sequence), stamp)
    good = [name for name in source.got if name != "wrong"]
    assert len(set(names(1, 40)) - set(good)) <= 1, source.counters
    assert good == sorted(good, key=int)


def test_nine_hundred_too_many() -> None:
    source = Source()
    source.run(1, 20)
    source.send("wrong", source.stamp(920))
    source.run(21, 40)
    assert source.got == names(1, 40)
    assert source.counters == {"rejected_implausible": 1}


def test_an_hour_too_late() -> None:
    source = Source()
    source.run(1, 20)
    stamp = source.stamp(21)
    source.send("21", replace(stamp, monotonic_ns=stamp.monotonic_ns + 3600 * 10**9))
    source.run(22, 40)
    assert source.got == names(1, 40), "its age is for others to judge"


@given(lost=st.integers(1, 5000), before=st.integers(2, 20))
def test_a_real_gap_is_passed_at_once_and_counted(lost: int, before: int) -> None:
    source = Source()
    source.run(1, before)
    source.wait(lost * PERIOD_NS)
    source.run(before + lost + 1, before + lost + 3)
    assert source.got == names(1, before) + names(before + lost + 1, before + lost + 3)
    assert source.counters == {"lost_on_bus": lost}


def test_a_gap_in_a_burst_is_passed_with_the_next_message() -> None:
    """After a stall many messages come at one instant, and some of them were lost."""
    source = Source()
    source.run(1, 10)
    source.wait(100 * PERIOD_NS)
    for sequence in (*range(11, 40), *range(90, 111)):
        source.send(str(sequence), source.stamp(sequence), after_ns=0)
    assert source.got == names(1, 39) + names(90, 110)
    assert source.counters == {"lost_on_bus": 50}


@pytest.mark.parametrize("session", [0, A])
def test_a_restart_that_is_not_named_is_followed_without_loss(session: int) -> None:
    source = Source()
    source.run(1, 50, session)
    source.run(1, 20, session, name="again ")
    assert source.got == names(1, 50) + names(1, 20, "again ")
    assert source.counters == {"restarts": 1}


def test_overtaken_messages_are_dropped() -> None:
    source = Source()
    source.run(1, 12)
    late = [source.stamp(10), source.stamp(11)]
    source.run(13, 14)
    for stamp in late:
        source.send("late", replace(stamp, monotonic_ns=stamp.monotonic_ns - 5 * PERIOD_NS))
    source.run(15, 20)
    assert source.got == names(1, 20)
    assert source.counters == {"reordered": 2}


class TestSessions:
    def test_two_senders_are_never_mixed(self) -> None:
        source = Source()
        source.run(1, 3)
        for sequence in range(4, 300):
            source.send(str(sequence), source.stamp(sequence))
            source.send(f"b{sequence}", source.stamp(sequence * 7, B), after_ns=0)
        assert source.got == names(1, 299)
        assert source.counters == {"other_session": 296}

    def test_two_that_begin_at_one_instant_are_not_mixed_either(self) -> None:
        source = Source()
        for sequence in range(1, 300):
            source.send(f"a{sequence}", source.stamp(sequence))
            source.send(f"b{sequence}", source.stamp(sequence * 7, B), after_ns=0)
        assert len({name[0] for name in source.got[2:]}) == 1
        assert len(source.got) >= 297

    @pytest.mark.parametrize("sessions", [(A, B), (0, B), (A, 0)])
    def test_the_next_one_is_followed_after_a_silence(self, sessions: tuple[int, int]) -> None:
        old, new = sessions
        source = Source()
        source.run(1, 50, old)
        source.wait(SILENT_NS)
        source.run(1, 20, new, name="new ")
        assert source.got == names(1, 50) + names(1, 20, "new ")
        assert source.counters == {"restarts": 1}

    def test_without_a_silence_the_newcomer_waits_for_it(self) -> None:
        source = Source()
        source.run(1, 50)
        source.run(1, 200, B, name="new ")
        first = SILENT_NS // PERIOD_NS + 1
        assert source.got == names(1, 50) + names(first, 200, "new ")
        assert source.counters == {"other_session": first - 1, "restarts": 1}

    def test_two_newcomers_do_not_keep_one_another_out(self) -> None:
        source = Source()
        source.run(1, 50)
        source.wait(SILENT_NS)
        for sequence in range(1, 20):
            source.send(f"b{sequence}", source.stamp(sequence, B))
            source.send(f"c{sequence}", source.stamp(sequence, C))
        assert source.got == names(1, 50) + names(1, 19, "b")

    def test_a_claim_that_passes_is_followed_at_once(self) -> None:
        source = Source(held={A})
        source.run(1, 50)
        source.held = {B}
        source.run(1, 20, B, name="new ")
        assert source.got == names(1, 50) + names(1, 20, "new ")

    def test_while_its_claim_stands_a_silent_sender_keeps_its_place(self) -> None:
        source = Source(held={A})
        source.run(1, 50)
        source.wait(10 * SILENT_NS)
        source.run(1, 20, B, name="rival ")
        source.run(51, 60)
        assert source.got == names(1, 60)
        assert source.counters == {"other_session": 20}

    def test_of_two_without_a_name_the_serial_number_tells(self) -> None:
        source = Source()
        source.run(1, 50, 0)
        continuity = source._continuity
        at_ns = source._at_ns
        for sequence in range(1, 20):
            taken = continuity.take(
                "other", source.stamp(sequence, 0), serial="T", arrived_ns=at_ns + sequence
            )
            assert not taken
        assert source.counters == {"other_session": 19}

    def test_a_lossless_replay_takes_whatever_the_record_holds(self) -> None:
        source = Source(trusting=True)
        source.run(1, 50)
        source.run(1, 20, B, name="new ")
        source.run(500, 520, B, name="later ")
        assert source.got == names(1, 50) + names(1, 20, "new ") + names(500, 520, "later ")


def test_after_drops_of_unknown_number_a_hole_is_not_lost_on_the_bus() -> None:
    source = Source()
    source.run(1, 10)
    source._continuity.drops_unknown()
    source.wait(SILENT_NS)
    source.run(50, 55)
    source.wait(SILENT_NS)
    source.run(60, 61)
    assert source.counters == {"dropped": 39, "lost_on_bus": 4}


def test_holes_are_counted_by_key_whenever_their_neighbours_come() -> None:
    holes, source = Holes(), Source()

    def came(key: str, *sequences: int, session: int = A) -> list[int]:
        stamps = [source.stamp(sequence, session) for sequence in sequences]
        return [holes.take(key, stamp, arrived_ns=10**9, serial="S") for stamp in stamps]

    assert came("a", 7, 8, 10, 11) == [0, 0, 1, 0]
    # So many cannot have been sent meanwhile, until the next one says so, too.
    assert came("a", 5011, 5012) == [0, 4999]
    assert came("a", 2**40, 5013) == [0, 0]
    assert came("b", 1, 2) == [0, 0]
    assert holes.lost == {"a": 5000, "b": 0}
