"""Upload and download of missions, fences and rally points, by MAVLink's mission protocol.

What is loaded lasts as long as the process.
"""

import dataclasses
import math
import time
from collections.abc import Callable
from functools import partial

from pymavlink.dialects.v20 import common as mavlink

from aircraft.state import ZERO
from link.bus.mavlink import Message
from sitl.autopilot import plan
from sitl.autopilot.fence import Fence, Rally
from sitl.autopilot.parameters import crc32
from sitl.autopilot.plan import NOT_GIVEN, BadItem, Item
from sitl.autopilot.services import Microservice, Reply, Request
from sitl.autopilot.telemetry import Snapshot, mission_current
from sitl.autopilot.vehicle import Vehicle

RETRY_S = 0.25  # real time after which an item is asked for again: PX4's value; clients live in real time
ACTION_S = 5.0  # real time without an item after which an upload is given up: PX4's value
MISSION, FENCE, RALLY = (
    mavlink.MAV_MISSION_TYPE_MISSION,
    mavlink.MAV_MISSION_TYPE_FENCE,
    mavlink.MAV_MISSION_TYPE_RALLY,
)
MOST_ITEMS = {MISSION: 2000, FENCE: 64, RALLY: 32}  # PX4's limits
NAMES = {MISSION: "Mission", FENCE: "Fence", RALLY: "Rally points"}

Items = tuple[Item, ...]


class Upload:
    """An upload under way: who sends which list, and the items so far."""

    def __init__(self, request: Request) -> None:
        message = request.message
        self.partner, self.link = request.asker, request.streams  # stations often share their ids
        self.mission_type, self.count = message.mission_type, message.count
        self.items: list[Item] = []
        self.current = 0
        self.floats = False  # True if the partner speaks MISSION_ITEM with floats only
        self.heard_s = self.asked_s = 0.0

    def is_from(self, request: Request) -> bool:
        """True if a request comes from the partner."""
        return self.partner == request.asker and self.link is request.streams

    def ask(self, now_s: float) -> Reply:
        """Return the request for the next item."""
        self.asked_s = now_s
        form = (
            mavlink.MAVLink_mission_request_message
            if self.floats
            else mavlink.MAVLink_mission_request_int_message
        )
        return Reply([form(*self.partner, len(self.items), self.mission_type)])


class PlanService:
    """The lists on board of one vehicle. An upload that fails or ends half-way changes nothing.

    The clock is real time, s.
    """

    def __init__(self, vehicle: Vehicle, clock: Callable[[], float] = time.monotonic) -> None:
        self._vehicle, self._clock = vehicle, clock
        self._items: dict[int, Items] = dict.fromkeys(MOST_ITEMS, ())
        self._upload: Upload | None = None
        self._last: Upload | None = None  # the last upload that was accepted
        self.services = tuple(
            Microservice(name, partial(_answered, answer), says, answer is not _no_part)
            for name, answer, says in (
                ("MISSION_REQUEST_LIST", self._count, "MISSION_COUNT"),
                ("MISSION_REQUEST_INT", self._item, "MISSION_ITEM_INT as it was uploaded"),
                ("MISSION_REQUEST", self._item, "MISSION_ITEM, with floats"),
                (
                    "MISSION_COUNT",
                    self._begin,
                    "MISSION_REQUEST_INT of the first item; with 0 items the list is cleared",
                ),
                (
                    "MISSION_ITEM_INT",
                    self._take,
                    "the request of the next item, or MISSION_ACK; a bad item ends the upload",
                ),
                ("MISSION_ITEM", self._take, "the same; from then on items are requested by MISSION_REQUEST"),
                ("MISSION_ACK", self._end, "nothing; OPERATION_CANCELLED ends an upload"),
                ("MISSION_CLEAR_ALL", self._clear, "MISSION_ACK; type 255 clears all three lists"),
                (
                    "MISSION_SET_CURRENT",
                    self._set_current,
                    "MISSION_CURRENT; of an item that is not there MISSION_ACK",
                ),
                ("MISSION_WRITE_PARTIAL_LIST", _no_part, "MISSION_ACK: unsupported"),
                ("MISSION_REQUEST_PARTIAL_LIST", _no_part, "MISSION_ACK: unsupported"),
            )
        )

    def next_s(self) -> float:
        """Return when to call `due` again, in real time; infinity if no upload is under way."""
        return self._upload.asked_s + RETRY_S if self._upload else math.inf

    def due(self, link: object) -> Reply:
        """Return what to send over a link now: the request of a missing item, or the end of the upload."""
        upload, now_s = self._upload, self._clock()
        if not upload or upload.link is not link or now_s < upload.asked_s + RETRY_S:
            return Reply([])
        if now_s < upload.heard_s + ACTION_S:
            return upload.ask(now_s)
        self._upload = None
        return Reply(
            [],
            f"{NAMES[upload.mission_type]} upload given up: no item {len(upload.items)} for {ACTION_S:g} s",
        )

    # ---- downloads: each request is answered by itself ----

    def _count(self, request: Request) -> Reply:
        mission_type = request.message.mission_type
        if mission_type not in self._items:
            raise BadItem(mavlink.MAV_MISSION_INVALID, f"List refused: type {mission_type} is not 0, 1 or 2")
        items = self._items[mission_type]
        return Reply([mavlink.MAVLink_mission_count_message(*request.asker, len(items), mission_type)])

    def _item(self, request: Request) -> Reply:
        seq, mission_type = request.message.seq, request.message.mission_type
        items = self._items.get(mission_type, ())
        if not 0 <= seq < len(items):
            raise BadItem(mavlink.MAV_MISSION_INVALID_SEQUENCE, f"No item {seq}: the list has {len(items)}")
        item = items[seq]
        current = int(mission_type == MISSION and self._vehicle.mission.current == seq)
        head = seq, item.frame, item.command, current, item.autocontinue, *item.params
        form, x, y = mavlink.MAVLink_mission_item_int_message, item.x, item.y
        if request.message.get_type() == "MISSION_REQUEST":
            form = mavlink.MAVLink_mission_item_message
            x, y = (math.nan if value == NOT_GIVEN else value / _unit(item.frame) for value in (x, y))
        return Reply([form(*request.asker, *head, x, y, item.z, mission_type)])

    # ---- uploads ----

    def _begin(self, request: Request) -> Reply:
        upload = Upload(request)
        if self._upload and not self._upload.is_from(request):
            system, component = self._upload.partner
            raise BadItem(mavlink.MAV_MISSION_ERROR, f"Upload refused: {system}/{component} is uploading")
        if upload.mission_type not in self._items:
            raise BadItem(
                mavlink.MAV_MISSION_INVALID, f"Upload refused: type {upload.mission_type} is not 0, 1 or 2"
            )
        if upload.count > (most := MOST_ITEMS[upload.mission_type]):
            raise BadItem(
                mavlink.MAV_MISSION_NO_SPACE,
                f"{NAMES[upload.mission_type]} refused: {upload.count} items, allowed are {most}",
            )
        return self._go_on(request, upload)

    def _take(self, request: Request) -> Reply:
        message, upload = request.message, self._upload
        if upload is None or not upload.is_from(request):
            if not upload and self._last and _is_last(request, self._last):
                return _acknowledged(request)  # the acknowledgement was lost
            raise BadItem(mavlink.MAV_MISSION_ERROR, f"Item {message.seq} refused: no upload under way")
        if message.mission_type != upload.mission_type:
            raise BadItem(
                mavlink.MAV_MISSION_ERROR, f"Item {message.seq} refused: it is of type {message.mission_type}"
            )
        upload.heard_s = self._clock()
        if message.seq < upload.count and message.seq != len(upload.items):
            return Reply([])  # repeated or out of sequence: the request is repeated when it is due
        self._upload = None  # a bad item ends it
        if message.seq >= upload.count:
            raise BadItem(
                mavlink.MAV_MISSION_INVALID_SEQUENCE,
                f"Item {message.seq} refused: the list has {upload.count}",
            )
        item = _read(message)
        try:
            plan.check(item, upload.mission_type, upload.count, self._vehicle.config)
        except BadItem as error:
            raise BadItem(
                error.code, f"{NAMES[upload.mission_type]} refused: item {message.seq}: {error}"
            ) from None
        upload.items.append(item)
        upload.current = message.seq if message.current else upload.current
        upload.floats = message.get_type() == "MISSION_ITEM"
        return self._go_on(request, upload)

    def _go_on(self, request: Request, upload: Upload) -> Reply:
        """Ask for the next item, or put the whole list in place of the old one."""
        upload.heard_s = self._clock()
        if len(upload.items) < upload.count:
            self._upload = upload
            return upload.ask(upload.heard_s)
        self._upload = None
        self._load(upload.mission_type, tuple(upload.items), request.t_s, upload.current)
        self._last = upload
        return _acknowledged(request)

    def _load(self, mission_type: int, items: Items, t_s: float, current: int = 0) -> None:
        """Load a list into the vehicle; raises BadItem if it does not fit."""
        vehicle, config = self._vehicle, self._vehicle.config
        number = crc32(b"".join(item.packed for item in items))  # PX4's id of a list; 0 of an empty one
        if mission_type == FENCE:
            fence = plan.fence(items, number, config)
            self._check_fence(fence, t_s)
            vehicle.configure(t_s, dataclasses.replace(config, fence=fence))
        elif mission_type == RALLY:
            places = tuple(plan.place(item, config) for item in items)
            vehicle.configure(t_s, dataclasses.replace(config, rally=Rally(places, number)))
        elif (
            number != vehicle.mission.number or not items
        ):  # as in PX4, the same mission again changes nothing
            vehicle.load(t_s, tuple(plan.step(item, len(items), config) for item in items), number, current)
        self._items[mission_type] = items

    def _check_fence(self, fence: Fence, t_s: float) -> None:
        """Refuse a fence that home or a vehicle in flight lies outside of, as PX4 does."""
        state = self._vehicle.state(t_s)
        flies = state.armed and state.landed_state != mavlink.MAV_LANDED_STATE_ON_GROUND
        if not fence.allows(ZERO):
            raise BadItem(mavlink.MAV_MISSION_DENIED, "Fence refused: home is outside it")
        if flies and not fence.allows(state.position):
            raise BadItem(mavlink.MAV_MISSION_DENIED, "Fence refused: the vehicle is outside it")

    def _end(self, request: Request) -> Reply:
        """Take a MISSION_ACK of the partner: it may cancel its upload, or not know the kind of request."""
        upload, result = self._upload, request.message.type
        if upload and upload.is_from(request):
            if result == mavlink.MAV_MISSION_OPERATION_CANCELLED:
                self._upload = None
            elif result == mavlink.MAV_MISSION_UNSUPPORTED:
                upload.floats = not upload.floats
                return upload.ask(self._clock())
        return Reply([])

    # ---- the rest ----

    def _clear(self, request: Request) -> Reply:
        if self._upload and not self._upload.is_from(request):
            raise BadItem(mavlink.MAV_MISSION_ERROR, "Clear refused: an upload is under way")
        wanted = request.message.mission_type
        types = tuple(self._items) if wanted == mavlink.MAV_MISSION_TYPE_ALL else (wanted,)
        if types[0] not in self._items:
            raise BadItem(mavlink.MAV_MISSION_INVALID, f"Clear refused: type {wanted} is not 0, 1, 2 or 255")
        self._upload = None
        for mission_type in types:
            self._load(mission_type, (), request.t_s)
        return _acknowledged(request)

    def _set_current(self, request: Request) -> Reply:
        result = self._vehicle.set_current(request.t_s, request.message.seq)
        if not result.accepted:
            raise BadItem(mavlink.MAV_MISSION_INVALID_SEQUENCE, result.reason)
        state = self._vehicle.state(request.t_s)
        return Reply([mission_current(Snapshot(self._vehicle.config, state, (0.0, 0.0), None))])


def _is_last(request: Request, upload: Upload) -> bool:
    """True if a request brings the last item of an upload again."""
    message = request.message
    return (
        upload.is_from(request)
        and message.mission_type == upload.mission_type
        and message.seq == upload.count - 1
        and _read(message).packed == upload.items[-1].packed
    )


def _read(message: Message) -> Item:
    """Return the item of a MISSION_ITEM_INT (73) or a MISSION_ITEM (39)."""
    x, y = message.x, message.y
    if message.get_type() == "MISSION_ITEM":
        unit = _unit(message.frame)
        x, y = (
            round(at * unit) if abs(at) * unit < NOT_GIVEN else NOT_GIVEN
            for at in (x, y)  # NaN is not less
        )
    return Item(
        message.command,
        message.frame,
        message.autocontinue,
        (message.param1, message.param2, message.param3, message.param4),
        x,
        y,
        message.z,
    )


def _unit(frame: int) -> float:
    """How many of a MISSION_ITEM_INT's x and y make 1 of a MISSION_ITEM's."""
    return 1.0 if frame == mavlink.MAV_FRAME_MISSION else 1e7


def _answered(answer: Callable[[Request], Reply], request: Request) -> Reply:
    """Return an answer, or the MISSION_ACK that refuses the request."""
    try:
        return answer(request)
    except BadItem as error:
        return Reply(_acknowledged(request, error.code).messages, str(error))


def _acknowledged(request: Request, result: int = mavlink.MAV_MISSION_ACCEPTED) -> Reply:
    mission_type = getattr(request.message, "mission_type", MISSION)
    return Reply([mavlink.MAVLink_mission_ack_message(*request.asker, result, mission_type)])


def _no_part(_: Request) -> Reply:
    raise BadItem(mavlink.MAV_MISSION_UNSUPPORTED, "Partial list refused: only whole lists are taken")
