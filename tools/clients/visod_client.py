"""visod's odometry, features and health in Python: shared memory in, dataclasses out.

    from visod_client import OdometrySubscriber

    with OdometrySubscriber() as odometry:
        for estimate in odometry:              # waits, for ever
            print(estimate.sequence, estimate.position_m, estimate.sigma_m)

Needs `pip install -r requirements.txt`. The layouts are those of the crate's modules
`output::message`, `output::features` and `output::health`, byte for byte. Run it as the user of the daemon: iceoryx2
lets nobody else in, and says nothing about it.
"""

from __future__ import annotations

import ctypes
import math
import os
import time
from dataclasses import dataclass
from typing import Generic, Iterator, Optional, Tuple, TypeVar

import iceoryx2 as iox2
import numpy as np
from numpy.typing import NDArray

ODOMETRY_SERVICE = "visod/odometry"
FEATURES_SERVICE = "visod/features"
HEALTH_SERVICE = "visod/health"
MAX_FEATURES = 512

# Sizes of the services; whoever comes first creates them, so all must agree.
_BUFFERS = {ODOMETRY_SERVICE: 512, FEATURES_SERVICE: 8, HEALTH_SERVICE: 16}
_MAX_SUBSCRIBERS = 16
_MAX_PUBLISHERS = 4
_MAX_NODES = 40
_EVENT_LEAVING = 1
_EVENT_CONNECTED = 2
_EVENT_MAX = 7

STATUSES = ("initializing", "tracking", "degraded", "lost")
FRAMES = ("left_camera", "base")
CAMERA_STATES = ("closed", "opening", "streaming", "stalled", "lost")
RIG_STATES = ("unwatched", "good", "moved", "misfits")
BUDGET_PARTS = ("detection", "calibration", "synchronisation", "bridging")
STAGES = ("capture", "features", "matching", "estimation", "total")

_AXES = ("x", "y", "z", "rx", "ry", "rz")
_FLAG_REPLAY = 1
_FLAG_BEYOND_FIRST_ORDER = 4

_VECTORS = (
    "position_m", "orientation_xyzw", "motion_translation_m", "motion_rotation_xyzw", "twist",
)  # fmt: skip
_MATRICES = ("cov_pose", "cov_motion", "cov_twist")
_UPPER = np.triu_indices(6)

Array = NDArray[np.float64]

# One entry of `visod/features`.
FEATURE = np.dtype(
    [
        ("id", "<u8"),
        ("age", "<u4"),
        ("reserved", "<u4"),
        ("left_px", "<f4", 2),
        ("right_px", "<f4", 2),
        ("point_m", "<f8", 3),
        ("cov_m2", "<f8", 6),
    ]
)


class MessageError(ValueError):
    """A message that this client cannot use."""


class ServiceError(RuntimeError):
    """A service that this client cannot use."""


class OdometryMessage(ctypes.Structure):
    """`visod/odometry`, layout version 1."""

    MAGIC = int.from_bytes(b"VIOD", "little")
    VERSION = 1
    _fields_ = [
        ("magic", ctypes.c_uint32),
        ("version", ctypes.c_uint32),
        ("size", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("sequence", ctypes.c_uint64),
        ("message_number", ctypes.c_uint64),
        ("realtime_ns", ctypes.c_int64),
        ("monotonic_ns", ctypes.c_int64),
        ("published_monotonic_ns", ctypes.c_int64),
        ("epoch", ctypes.c_uint32),
        ("status", ctypes.c_uint32),
        ("frame", ctypes.c_uint32),
        ("budget_modelled", ctypes.c_uint32),
        ("keypoints_left", ctypes.c_uint32),
        ("keypoints_right", ctypes.c_uint32),
        ("stereo_matches", ctypes.c_uint32),
        ("tracks", ctypes.c_uint32),
        ("inliers", ctypes.c_uint32),
        ("undetermined", ctypes.c_uint32),
        ("variance_factor", ctypes.c_double),
        ("position_m", ctypes.c_double * 3),
        ("orientation_xyzw", ctypes.c_double * 4),
        ("motion_translation_m", ctypes.c_double * 3),
        ("motion_rotation_xyzw", ctypes.c_double * 4),
        ("twist", ctypes.c_double * 6),
        ("cov_pose", ctypes.c_double * 36),
        ("cov_motion", ctypes.c_double * 36),
        ("cov_twist", ctypes.c_double * 36),
        ("budget_detection", ctypes.c_double * 21),
        ("budget_calibration", ctypes.c_double * 21),
        ("budget_synchronisation", ctypes.c_double * 21),
        ("budget_bridging", ctypes.c_double * 21),
        ("latency_capture_ns", ctypes.c_uint64),
        ("latency_features_ns", ctypes.c_uint64),
        ("latency_matching_ns", ctypes.c_uint64),
        ("latency_estimation_ns", ctypes.c_uint64),
        ("latency_total_ns", ctypes.c_uint64),
        ("innovation_ratio", ctypes.c_double),
    ]

    @staticmethod
    def type_name() -> str:
        """The name by which iceoryx2 knows that both sides mean the same layout."""
        return "visod::OdometryMessage.1"


class FeaturesMessage(ctypes.Structure):
    """`visod/features`, layout version 1."""

    MAGIC = int.from_bytes(b"VIOF", "little")
    VERSION = 1
    _fields_ = [
        ("magic", ctypes.c_uint32),
        ("version", ctypes.c_uint32),
        ("size", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("sequence", ctypes.c_uint64),
        ("message_number", ctypes.c_uint64),
        ("realtime_ns", ctypes.c_int64),
        ("monotonic_ns", ctypes.c_int64),
        ("published_monotonic_ns", ctypes.c_int64),
        ("epoch", ctypes.c_uint32),
        ("status", ctypes.c_uint32),
        ("count", ctypes.c_uint32),
        ("left_out", ctypes.c_uint32),
        ("position_m", ctypes.c_double * 3),
        ("orientation_xyzw", ctypes.c_double * 4),
        # Doubles for their alignment; FEATURE says what they are.
        ("features", ctypes.c_double * (MAX_FEATURES * FEATURE.itemsize // 8)),
    ]

    @staticmethod
    def type_name() -> str:
        """The name by which iceoryx2 knows that both sides mean the same layout."""
        return "visod::FeaturesMessage.1"


class HealthMessage(ctypes.Structure):
    """`visod/health`, layout version 1."""

    MAGIC = int.from_bytes(b"VIOH", "little")
    VERSION = 1
    _fields_ = [
        ("magic", ctypes.c_uint32),
        ("version", ctypes.c_uint32),
        ("size", ctypes.c_uint32),
        ("odometry_status", ctypes.c_uint32),
        ("message_number", ctypes.c_uint64),
        ("realtime_ns", ctypes.c_int64),
        ("monotonic_ns", ctypes.c_int64),
        ("left_state", ctypes.c_uint32),
        ("right_state", ctypes.c_uint32),
        ("left_frames", ctypes.c_uint64),
        ("right_frames", ctypes.c_uint64),
        ("left_reconnects", ctypes.c_uint64),
        ("right_reconnects", ctypes.c_uint64),
        ("left_last_monotonic_ns", ctypes.c_int64),
        ("right_last_monotonic_ns", ctypes.c_int64),
        ("left_lost_in_transport", ctypes.c_uint64),
        ("right_lost_in_transport", ctypes.c_uint64),
        ("left_unreadable", ctypes.c_uint64),
        ("right_unreadable", ctypes.c_uint64),
        ("left_unmatched", ctypes.c_uint64),
        ("right_unmatched", ctypes.c_uint64),
        ("pairs_processed", ctypes.c_uint64),
        ("pairs_unusable", ctypes.c_uint64),
        ("pairs_dropped", ctypes.c_uint64),
        ("pairs_degraded", ctypes.c_uint64),
        ("pairs_lost", ctypes.c_uint64),
        ("restarts", ctypes.c_uint64),
        ("over_budget", ctypes.c_uint64),
        ("publish_failures", ctypes.c_uint64),
        ("budget_ns", ctypes.c_uint64),
        ("busy_mean_ns", ctypes.c_uint64),
        ("busy_max_ns", ctypes.c_uint64),
        ("uptime_ns", ctypes.c_uint64),
        ("subscribers", ctypes.c_uint64),
        ("degraded_mode", ctypes.c_uint32),
        ("features_permille", ctypes.c_uint32),
        ("overruns", ctypes.c_uint64),
        ("rig_state", ctypes.c_uint32),
        ("rig_pitch_nrad", ctypes.c_int32),
        ("rig_yaw_nrad", ctypes.c_int32),
        ("rig_roll_nrad", ctypes.c_int32),
    ]

    @staticmethod
    def type_name() -> str:
        """The name by which iceoryx2 knows that both sides mean the same layout."""
        return "visod::HealthMessage.1"


@dataclass(frozen=True, eq=False)
class Odometry:
    """One estimate. Covariances are ordered x, y, z, rx, ry, rz (m², m·rad, rad²).

    Vectors and matrices are views of one copy of the message, read-only.
    """

    sequence: int
    message_number: int
    epoch: int
    status: str
    frame: str
    replay: bool
    realtime_ns: int
    monotonic_ns: Optional[int]
    published_monotonic_ns: int
    position_m: Array  # (3,)
    orientation_xyzw: Array  # (4,)
    cov_pose: Array  # (6, 6)
    motion_translation_m: Array  # (3,)
    motion_rotation_xyzw: Array  # (4,)
    cov_motion: Array  # (6, 6)
    twist: Array  # (6,)
    cov_twist: Array  # (6, 6)
    budget: dict[str, Optional[Array]]  # (6, 6) each
    keypoints_left: int
    keypoints_right: int
    stereo_matches: int
    tracks: int
    inliers: int
    variance_factor: float
    innovation_ratio: float
    undetermined: tuple[str, ...]  # axes of the motion that the images leave open
    first_order: bool
    latencies_ns: dict[str, Optional[int]]

    @property
    def sigma_m(self) -> Array:
        """1 σ of the position, m."""
        return np.sqrt(np.maximum(np.diag(self.cov_pose)[:3], 0.0))

    @property
    def sigma_rad(self) -> Array:
        """1 σ of the orientation about the fixed axes, rad."""
        return np.sqrt(np.maximum(np.diag(self.cov_pose)[3:], 0.0))

    @staticmethod
    def from_message(message: OdometryMessage) -> "Odometry":
        """Checks a message and copies it out of shared memory."""
        _check_layout(message, OdometryMessage)
        m = OdometryMessage.from_buffer_copy(message)
        vectors = {name: _view(getattr(m, name)) for name in _VECTORS}
        matrices = {name: _view(getattr(m, name)).reshape(6, 6) for name in _MATRICES}
        if not all(np.isfinite(a).all() for a in (*vectors.values(), *matrices.values())):
            raise MessageError("the message holds a number that is not finite")
        return Odometry(
            sequence=m.sequence,
            message_number=m.message_number,
            epoch=m.epoch,
            status=_word(STATUSES, m.status, "status"),
            frame=_word(FRAMES, m.frame, "frame"),
            replay=bool(m.flags & _FLAG_REPLAY),
            realtime_ns=m.realtime_ns,
            monotonic_ns=m.monotonic_ns or None,
            published_monotonic_ns=m.published_monotonic_ns,
            **vectors,
            **matrices,
            budget={
                part: _symmetric(_view(getattr(m, f"budget_{part}")))
                if m.budget_modelled >> bit & 1
                else None
                for bit, part in enumerate(BUDGET_PARTS)
            },
            keypoints_left=m.keypoints_left,
            keypoints_right=m.keypoints_right,
            stereo_matches=m.stereo_matches,
            tracks=m.tracks,
            inliers=m.inliers,
            variance_factor=m.variance_factor,
            innovation_ratio=m.innovation_ratio,
            undetermined=tuple(name for bit, name in enumerate(_AXES) if m.undetermined >> bit & 1),
            first_order=not m.flags & _FLAG_BEYOND_FIRST_ORDER,
            latencies_ns={
                stage: getattr(m, f"latency_{stage}_ns") or None for stage in STAGES
            },
        )


@dataclass(frozen=True, eq=False)
class Features:
    """The features that an estimate rests on."""

    sequence: int
    message_number: int
    epoch: int
    status: str
    replay: bool
    realtime_ns: int
    monotonic_ns: Optional[int]
    published_monotonic_ns: int
    left_out: int
    position_m: Array  # (3,), of the left camera in the odometry frame
    orientation_xyzw: Array  # (4,)
    features: np.ndarray  # (n,) of FEATURE: id, age, left_px, right_px, point_m, cov_m2

    @staticmethod
    def from_message(message: FeaturesMessage) -> "Features":
        """Checks a message and copies it out of shared memory."""
        _check_layout(message, FeaturesMessage)
        if message.count > MAX_FEATURES:
            raise MessageError(f"the message says that it holds {message.count} features")
        m = FeaturesMessage.from_buffer_copy(message)
        features = np.frombuffer(m, FEATURE, m.count, FeaturesMessage.features.offset)
        features.setflags(write=False)
        return Features(
            sequence=m.sequence,
            message_number=m.message_number,
            epoch=m.epoch,
            status=_word(STATUSES, m.status, "status"),
            replay=bool(m.flags & _FLAG_REPLAY),
            realtime_ns=m.realtime_ns,
            monotonic_ns=m.monotonic_ns or None,
            published_monotonic_ns=m.published_monotonic_ns,
            left_out=m.left_out,
            position_m=_view(m.position_m),
            orientation_xyzw=_view(m.orientation_xyzw),
            features=features,
        )


@dataclass(frozen=True)
class Camera:
    """How one camera is."""

    state: str
    frames: int
    reconnects: int
    last_monotonic_ns: Optional[int]
    lost_in_transport: int
    unreadable: int
    unmatched: int


@dataclass(frozen=True)
class Health:
    """How the daemon is. Counters count from its start."""

    message_number: int
    odometry_status: str
    realtime_ns: int
    monotonic_ns: int
    left: Camera
    right: Camera
    pairs_processed: int
    pairs_unusable: int
    pairs_dropped: int
    pairs_degraded: int
    pairs_lost: int
    restarts: int
    over_budget: int
    publish_failures: int
    budget_ns: Optional[int]
    busy_mean_ns: int
    busy_max_ns: int
    uptime_ns: int
    subscribers: int
    degraded_mode: int
    features_permille: int
    overruns: int
    rig_state: str
    rig_pitch_nrad: int
    rig_yaw_nrad: int
    rig_roll_nrad: int

    @staticmethod
    def from_message(m: HealthMessage) -> "Health":
        """Checks a message and copies it out of shared memory."""
        _check_layout(m, HealthMessage)
        plain = (
            "message_number", "realtime_ns", "monotonic_ns", "pairs_processed", "pairs_unusable",
            "pairs_dropped", "pairs_degraded", "pairs_lost", "restarts", "over_budget",
            "publish_failures", "busy_mean_ns", "busy_max_ns", "uptime_ns", "subscribers",
            "degraded_mode", "features_permille", "overruns", "rig_pitch_nrad", "rig_yaw_nrad",
            "rig_roll_nrad",
        )  # fmt: skip
        return Health(
            odometry_status=_word(STATUSES, m.odometry_status, "odometry_status"),
            left=_camera(m, "left"),
            right=_camera(m, "right"),
            budget_ns=m.budget_ns or None,
            rig_state=_word(RIG_STATES, m.rig_state, "rig_state"),
            **{name: getattr(m, name) for name in plain},
        )


def _camera(m: HealthMessage, side: str) -> Camera:
    def field(name: str) -> int:
        return getattr(m, f"{side}_{name}")

    return Camera(
        state=_word(CAMERA_STATES, field("state"), f"{side}_state"),
        frames=field("frames"),
        reconnects=field("reconnects"),
        last_monotonic_ns=field("last_monotonic_ns") or None,
        lost_in_transport=field("lost_in_transport"),
        unreadable=field("unreadable"),
        unmatched=field("unmatched"),
    )


def _check_layout(m, layout) -> None:
    if m.magic != layout.MAGIC:
        raise MessageError(f"not a {layout.__name__}: it begins with {m.magic:#010x}")
    if (m.version, m.size) != (layout.VERSION, ctypes.sizeof(layout)):
        raise MessageError(
            f"the message has layout version {m.version} of {m.size} bytes, but this client"
            f" knows version {layout.VERSION} of {ctypes.sizeof(layout)} bytes"
        )


def _word(words: Tuple[str, ...], code: int, field: str) -> str:
    if code >= len(words):
        raise MessageError(f"{field} of the message is {code}, which is not defined")
    return words[code]


def _view(array: ctypes.Array) -> Array:
    view = np.ctypeslib.as_array(array)
    view.setflags(write=False)
    return view


def _symmetric(triangle: Array) -> Array:
    matrix = np.empty((6, 6))
    matrix[_UPPER] = triangle
    matrix.T[_UPPER] = triangle
    matrix.setflags(write=False)
    return matrix


def _explain(cause: str) -> str:
    """iceoryx2's reasons in words, where a user can do something about them."""
    reasons = {
        "InsufficientPermissions": "its files belong to another user",
        "IncompatibleTypes": "a process of another version uses it",
        "VersionMismatch": "a process of another version uses it",
        "DoesNotSupportRequested": "a process that has it open created it with other sizes",
        "ExceedsMax": "too many processes use it already",
    }
    return next((f"{words} ({cause})" for word, words in reasons.items() if word in cause), cause)


T = TypeVar("T")


class _Subscriber(Generic[T]):
    """Receives the messages of one service. It may be opened before any publisher is there.

    `root` and `prefix` are the publisher's `publish.root` and `publish.prefix`; what is not given
    comes from iceoryx2's own configuration. `lost` counts messages that came faster than they were
    fetched.
    """

    _service: str
    _layout: type
    _decode: staticmethod

    def __init__(
        self,
        root: Optional[str | os.PathLike] = None,
        prefix: Optional[str] = None,
        node_name: str = "visod_client",
    ) -> None:
        iox2.set_log_level_from_env_or(iox2.LogLevel.Fatal)
        config = iox2.config.global_config()
        if root is not None:
            config.global_cfg.root_path = iox2.Path.new(os.fspath(root))
        if prefix is not None:
            config.global_cfg.prefix = iox2.FileName.new(prefix)
        self.lost = 0
        self._last: Optional[int] = None
        self._publisher = None
        # Signals stay with Python, so that Ctrl-C raises KeyboardInterrupt as everywhere.
        self._node = (
            iox2.NodeBuilder.new()
            .name(iox2.NodeName.new(node_name))
            .signal_handling_mode(iox2.SignalHandlingMode.Disabled)
            .config(config)
            .create(iox2.ServiceType.Ipc)
        )
        try:
            self._open()
        except Exception as e:  # iceoryx2's own errors have no common base but this
            # What iceoryx2 says goes on, but not as the last word.
            raise ServiceError(f"{self._service} cannot be used: {_explain(repr(e))}") from e

    def _open(self) -> None:
        name = iox2.ServiceName.new(self._service)
        self._events = (
            self._node.service_builder(name)
            .event()
            .event_id_max_value(_EVENT_MAX)
            .max_listeners(_MAX_SUBSCRIBERS + _MAX_PUBLISHERS)
            .max_notifiers(_MAX_SUBSCRIBERS + _MAX_PUBLISHERS)
            .max_nodes(_MAX_NODES)
            .open_or_create()
        )
        self._messages = (
            self._node.service_builder(name)
            .publish_subscribe(self._layout)
            .enable_safe_overflow(True)
            .subscriber_max_buffer_size(_BUFFERS[self._service])
            .history_size(1)
            .max_subscribers(_MAX_SUBSCRIBERS)
            .max_publishers(_MAX_PUBLISHERS)
            .max_nodes(_MAX_NODES)
            .open_or_create()
        )
        self._listener = self._events.listener_builder().create()
        self._notifier = (
            self._events.notifier_builder()
            .default_event_id(iox2.EventId.new(_EVENT_CONNECTED))
            .create()
        )
        self._subscriber = self._messages.subscriber_builder().create()

    def receive(self) -> Optional[T]:
        """The next message, if there is one. Raises MessageError for one that cannot be used."""
        sample = self._subscriber.receive()
        if sample is None:
            return None
        try:
            publisher = str(sample.header.publisher_id)
            message = self._decode(sample.payload().contents)
        finally:
            sample.delete()
        if publisher == self._publisher:
            self.lost += message.message_number - self._last - 1
        self._publisher, self._last = publisher, message.message_number
        return message

    def wait(self, timeout_s: Optional[float] = None) -> Optional[T]:
        """Waits for the next message; None if there was none in time."""
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            message = self.receive()
            if message is not None:
                return message
            left = math.inf if deadline is None else deadline - time.monotonic()
            if left <= 0:
                return None
            # Short enough for Ctrl-C, and for a last message handed to a late joiner, which has
            # no event.
            self._wait_for_event(min(left, 0.1))

    def _wait_for_event(self, timeout_s: float) -> None:
        events = self._listener.timed_wait(iox2.Duration.from_secs_f64(timeout_s))
        if any(event.id.as_value == _EVENT_LEAVING for event in events):
            # Connects to what a leaving publisher has sent, then tells it that it may go.
            self._subscriber.has_samples()
            self._notifier.notify()

    def __iter__(self) -> Iterator[T]:
        while True:
            yield self.wait()

    def close(self) -> None:
        """Leaves the service."""
        for port in (self._subscriber, self._listener, self._notifier):
            port.delete()

    def __enter__(self):
        return self

    def __exit__(self, *_) -> None:
        self.close()


class OdometrySubscriber(_Subscriber[Odometry]):
    """Receives odometry."""

    _service = ODOMETRY_SERVICE
    _layout = OdometryMessage
    _decode = staticmethod(Odometry.from_message)


class FeaturesSubscriber(_Subscriber[Features]):
    """Receives the features that estimates rest on, where `publish.features` is set."""

    _service = FEATURES_SERVICE
    _layout = FeaturesMessage
    _decode = staticmethod(Features.from_message)


class HealthSubscriber(_Subscriber[Health]):
    """Receives the state of the daemon."""

    _service = HEALTH_SERVICE
    _layout = HealthMessage
    _decode = staticmethod(Health.from_message)
