"""Configuration of the estimating services and of the recorder: one table of the profile each."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, ValidationInfo, field_validator, model_validator

from palpate.bus.topics import TOPICS
from palpate.config import Name, RouterOptions, StrictConfig, check_name
from palpate.process import data_folder, state_folder
from palpate.ros.rmw_zenoh import check_topic_name

DEFAULT_BUNDLE = "features-virtual"

LOADED_MOST = 32
"""Different bundles that a service has in memory, with those kept for a roll back."""

_UserPath = Annotated[Path, AfterValidator(Path.expanduser)]


class ModelsConfig(StrictConfig):
    """Where bundles are, beside the packaged ones, and what is remembered of them.

    Attributes:
        folder: The user's bundles: ``<name>/<version>/``; None = ``models`` in palpate's data
            folder of whoever runs the process.
        state: Where a station remembers what it serves, and keeps its admin token; None = palpate's
            state folder of whoever runs the process.
        trusted_keys: Public keys, as ``palpate model key`` makes them. With any, only bundles that
            one of them has signed are imported and served, beside those that ship with palpate.
    """

    folder: _UserPath | None = None
    state: _UserPath | None = None
    trusted_keys: tuple[_UserPath, ...] = Field(default=(), max_length=64)

    @property
    def repository_folder(self) -> Path:
        """The user's bundles."""
        return data_folder() / "models" if self.folder is None else self.folder

    @property
    def memory_folder(self) -> Path:
        """What is remembered, and the token."""
        return state_folder() if self.state is None else self.state

    def served_file(self, station: str, task: str, instance: str) -> Path:
        """What a service of a station remembers that it serves."""
        return self.memory_folder / "stations" / station / f"{task}.{instance}.json"


class EstimatingConfig(StrictConfig):
    """What all estimating services have in common.

    Attributes:
        bundle: Name of a bundle (newest version), ``name:version``, or the path of a bundle's
            folder.
        bundles: The same for sensors with a bundle of their own, by sensor.
        sensors: Sensors to serve; empty = every sensor of the station that a gateway claims.
        unannounced: With no ``sensors`` named, serve also those that no gateway claims, e.g. of a
            gateway that is older than claims.
        delivery: ``newest`` takes the newest message and counts those it skipped (live);
            ``every`` takes each and slows the source down (lossless replay).
        keep_newest: Messages per sensor that may wait with ``newest``: a service that was delayed
            by no more than these catches up without loss; ``max_age_s`` still applies.
        max_age_s: A live or simulated message older than this gets no estimate [s]; None = no
            limit.
        accept_replayed: Whether replayed messages get estimates; false on a live station.
        batch_wait_s: How long a message may wait for those of other sensors, to be computed with
            them [s]; 0 = only those that wait already.
        drain_s: How long a stopping service still processes messages that have arrived [s].
    """

    bundle: str
    bundles: dict[Name, str] = Field(default_factory=dict, max_length=256)
    sensors: tuple[Name, ...] = ()
    unannounced: bool = False
    delivery: Literal["newest", "every"] = "newest"
    keep_newest: int = Field(default=5, ge=1, le=100)
    max_age_s: float | None = Field(default=0.05, gt=0)
    accept_replayed: bool = False
    batch_wait_s: float = Field(default=0.0, ge=0, le=0.002)
    drain_s: float = Field(default=1.5, ge=0, le=30)

    @field_validator("bundles")
    @classmethod
    def _can_be_loaded(cls, value: dict[str, str], info: ValidationInfo) -> dict[str, str]:
        named = len({*value.values(), info.data.get("bundle", "")})
        if named > LOADED_MOST:
            raise ValueError(
                f"with bundle these are {named} different ones, a service loads {LOADED_MOST}"
            )
        return value


class ElectrodesConfig(EstimatingConfig):
    """What services that start from electrodes have in common.

    Attributes:
        tare_timeout_s: How long one frame may wait for a tare that was not announced [s].
    """

    tare_timeout_s: float = Field(default=0.2, gt=0, le=10)


class FeaturesServiceConfig(ElectrodesConfig):
    """The features service: electrodes to force and contact location."""

    bundle: str = DEFAULT_BUNDLE


class FieldServiceConfig(ElectrodesConfig):
    """The field service: electrodes to displacement fields.

    Attributes:
        rate_hz: Fields a second and sensor at most [Hz], by the clock of the frames: the first
            frame of each period gets one; None = every frame.
    """

    bundle: str = "field-twin"
    max_age_s: float | None = Field(default=0.1, gt=0)
    rate_hz: float | None = Field(default=20.0, gt=0, le=1000)


class SynthesisServiceConfig(EstimatingConfig):
    """The synthesis service: displacement fields to tared counts of the electrodes.

    Attributes:
        source: ``truth`` takes the known fields of a simulation (topic ``field_truth``),
            ``estimate`` those of the field service (topic ``field``).
        simulations: Questions that may wait for the finite-element service at the same time.
        simulation_s: Longest time for one of them [s].
        fluid_volume_m3: Fill of the finger that described contacts are simulated on [m^3]; that of
            the shipped bundle's training. None = the finite-element service's own.
    """

    bundle: str = "synthesis-twin"
    keep_newest: int = Field(default=1, ge=1, le=100)
    max_age_s: float | None = Field(default=0.2, gt=0)
    source: Literal["truth", "estimate"] = "truth"
    simulations: int = Field(default=2, ge=1, le=16)
    simulation_s: float = Field(default=120.0, gt=0, le=3600)
    fluid_volume_m3: float | None = Field(default=0.6e-6, gt=0, le=5e-6)


_LEAST_ROTATION = {"rotate_bytes": 64 * 1024, "rotate_s": 1}


class RecorderConfig(StrictConfig):
    """What is recorded, and where.

    Attributes:
        out: Folder of the records; made if absent.
        topics: Names of the topics to record; empty = all that are recorded by default.
        sensor: One sensor to record, or ``*`` for all.
        delivery: ``queue`` drops (and counts) when the disk cannot follow (live); ``every`` slows
            the source down instead (lossless replay).
        capacity: Messages that may wait for the disk.
        rrd: Whether a Rerun view is written beside each record.
        rrd_max_bytes: A view that reaches this size is closed; the record goes on [bytes].
        bundles: Bundles, by name or folder, that hold the meshes of the fields to draw, beside the
            packaged ones.
        min_free_bytes: Recording pauses while the disk has less free than this [bytes].
        field_rate_hz: Fields (topics ``field`` and ``field_truth``) recorded a second, topic and
            sensor [Hz], by the clock of the frames; 0 = all. One takes 82 kB that do not compress;
            those of the field service can be computed again from the recorded electrodes.
        rotate_bytes: Start a new record at this size [bytes]; 0 = never.
        rotate_s: Start a new record after this time [s]; 0 = never.
        keep_bytes: The oldest records are removed while all that this recorder wrote, with their
            views, are larger than this [bytes]; 0 = never. See ``recorder.retention``.
        keep_s: Records are removed when they are older than this [s]; 0 = never.
        drain_s: How long a stopping recorder still writes messages that have arrived [s]; a
            lossless replay needs longer than a live station.
        run: Stands in the metadata of its records, as ``run``: tells them from others in their
            folder; empty = nothing stands there.
    """

    out: Path = Path("runs")
    topics: tuple[str, ...] = ()
    sensor: str = "*"
    delivery: Literal["queue", "every"] = "queue"
    capacity: int = Field(default=50_000, ge=16)
    rrd: bool = True
    rrd_max_bytes: int = Field(default=2 * 1024**3, ge=1024**2)
    bundles: tuple[str, ...] = ()
    min_free_bytes: int = Field(default=256 * 1024**2, ge=0)
    field_rate_hz: float = Field(default=0.5, ge=0, le=1000)
    rotate_bytes: int = Field(default=512 * 1024**2, ge=0)
    rotate_s: float = Field(default=3600.0, ge=0)
    keep_bytes: int = Field(default=20 * 1024**3, ge=0)
    keep_s: float = Field(default=14 * 86400.0, ge=0)
    drain_s: float = Field(default=1.5, ge=0, le=60)
    run: str = ""

    @field_validator("topics")
    @classmethod
    def _known(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        if unknown := sorted(set(value) - set(TOPICS)):
            raise ValueError(f"unknown topic {unknown[0]!r}; known are {', '.join(TOPICS)}")
        return value

    @field_validator("sensor")
    @classmethod
    def _name_or_all(cls, value: str) -> str:
        return value if value == "*" else check_name(value)

    @field_validator("rotate_bytes", "rotate_s")
    @classmethod
    def _not_tiny(cls, value: float, info: ValidationInfo) -> float:
        least = _LEAST_ROTATION[str(info.field_name)]
        if 0 < value < least:
            raise ValueError(f"a record has at least {least}; 0 = never")
        return value

    @model_validator(mode="after")
    def _rotates_to_be_kept(self) -> Self:
        if self.keep_bytes and not 0 < self.rotate_bytes <= self.keep_bytes // 2:
            raise ValueError(
                "keep_bytes removes whole records: rotate_bytes must be at most half of it, "
                "or keep_bytes = 0"
            )
        return self


class RosBridgeConfig(RouterOptions):
    """The bridge to ROS: what is published for nodes of ROS 2 with rmw_zenoh.

    The router, ``connect`` and ``tls``, is the one that ROS uses (``rmw_zenohd``).

    Attributes:
        sensors: Sensors to publish; empty = every sensor of the station.
        namespace: Begin of the names of all topics: ``NAMESPACE/SENSOR/force`` and so on.
        frame_ids: Frame of each sensor in the headers, by sensor; else the sensor's name.
        domain: ROS domain id.
        humble: The nodes run ROS 2 Humble, whose keys have no type hash.
        capacity: Messages that may wait to be published.
    """

    sensors: tuple[Name, ...] = ()
    namespace: str = "/palpate"
    frame_ids: dict[Name, str] = Field(default_factory=dict, max_length=256)
    domain: int = Field(default=0, ge=0, le=232)
    humble: bool = False
    capacity: int = Field(default=1024, ge=16)

    @field_validator("namespace")
    @classmethod
    def _is_namespace(cls, value: str) -> str:
        return check_topic_name(value)


EVERYTHING: dict[str, float] = {
    "field_rate_hz": 0,
    "rotate_bytes": 0,
    "rotate_s": 0,
    "keep_bytes": 0,
    "keep_s": 0,
}
"""Keys of a recorder that keeps every message, in one record, and removes nothing."""
