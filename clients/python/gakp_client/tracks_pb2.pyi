from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Clock(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    CLOCK_UNSPECIFIED: _ClassVar[Clock]
    CLOCK_RTCP: _ClassVar[Clock]
    CLOCK_ARRIVAL: _ClassVar[Clock]
    CLOCK_MEDIA: _ClassVar[Clock]

class TrackState(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    TRACK_STATE_UNSPECIFIED: _ClassVar[TrackState]
    TRACK_STATE_TENTATIVE: _ClassVar[TrackState]
    TRACK_STATE_CONFIRMED: _ClassVar[TrackState]
    TRACK_STATE_LOST: _ClassVar[TrackState]
CLOCK_UNSPECIFIED: Clock
CLOCK_RTCP: Clock
CLOCK_ARRIVAL: Clock
CLOCK_MEDIA: Clock
TRACK_STATE_UNSPECIFIED: TrackState
TRACK_STATE_TENTATIVE: TrackState
TRACK_STATE_CONFIRMED: TrackState
TRACK_STATE_LOST: TrackState

class TrackMessage(_message.Message):
    __slots__ = ("frame", "gap")
    FRAME_FIELD_NUMBER: _ClassVar[int]
    GAP_FIELD_NUMBER: _ClassVar[int]
    frame: FrameTracks
    gap: Gap
    def __init__(self, frame: _Optional[_Union[FrameTracks, _Mapping]] = ..., gap: _Optional[_Union[Gap, _Mapping]] = ...) -> None: ...

class FrameTracks(_message.Message):
    __slots__ = ("camera", "epoch", "seq", "frame", "capture_unix_ns", "clock", "width", "height", "tracks", "ended")
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    EPOCH_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    CAPTURE_UNIX_NS_FIELD_NUMBER: _ClassVar[int]
    CLOCK_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    TRACKS_FIELD_NUMBER: _ClassVar[int]
    ENDED_FIELD_NUMBER: _ClassVar[int]
    camera: str
    epoch: int
    seq: int
    frame: int
    capture_unix_ns: int
    clock: Clock
    width: int
    height: int
    tracks: _containers.RepeatedCompositeFieldContainer[Track]
    ended: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, camera: _Optional[str] = ..., epoch: _Optional[int] = ..., seq: _Optional[int] = ..., frame: _Optional[int] = ..., capture_unix_ns: _Optional[int] = ..., clock: _Optional[_Union[Clock, str]] = ..., width: _Optional[int] = ..., height: _Optional[int] = ..., tracks: _Optional[_Iterable[_Union[Track, _Mapping]]] = ..., ended: _Optional[_Iterable[int]] = ...) -> None: ...

class Gap(_message.Message):
    __slots__ = ("camera", "epoch", "first", "last")
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    EPOCH_FIELD_NUMBER: _ClassVar[int]
    FIRST_FIELD_NUMBER: _ClassVar[int]
    LAST_FIELD_NUMBER: _ClassVar[int]
    camera: str
    epoch: int
    first: int
    last: int
    def __init__(self, camera: _Optional[str] = ..., epoch: _Optional[int] = ..., first: _Optional[int] = ..., last: _Optional[int] = ...) -> None: ...

class Track(_message.Message):
    __slots__ = ("id", "state", "x", "y", "w", "h", "confidence", "link", "vx", "vy", "matched")
    ID_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    CLASS_FIELD_NUMBER: _ClassVar[int]
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    W_FIELD_NUMBER: _ClassVar[int]
    H_FIELD_NUMBER: _ClassVar[int]
    CONFIDENCE_FIELD_NUMBER: _ClassVar[int]
    LINK_FIELD_NUMBER: _ClassVar[int]
    VX_FIELD_NUMBER: _ClassVar[int]
    VY_FIELD_NUMBER: _ClassVar[int]
    MATCHED_FIELD_NUMBER: _ClassVar[int]
    id: int
    state: TrackState
    x: float
    y: float
    w: float
    h: float
    confidence: float
    link: float
    vx: float
    vy: float
    matched: bool
    def __init__(self, id: _Optional[int] = ..., state: _Optional[_Union[TrackState, str]] = ..., x: _Optional[float] = ..., y: _Optional[float] = ..., w: _Optional[float] = ..., h: _Optional[float] = ..., confidence: _Optional[float] = ..., link: _Optional[float] = ..., vx: _Optional[float] = ..., vy: _Optional[float] = ..., matched: bool = ..., **kwargs) -> None: ...
