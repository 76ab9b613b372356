"""The service of missions, fences and rally points: uploads, downloads, what is current. What is loaded
lasts as long as the process.
"""

import dataclasses
import math
import time
from collections.abc import Callable

from pymavlink.dialects.v20 import common as mavlink

from link.bus.mavlink import Message
from sitl.autopilot import plan
from sitl.autopilot.fence import NO_FENCE, NO_RALLY, Fence, Rally
from sitl.autopilot.plan import NOT_GIVEN, BadItem, Item
from sitl.autopilot.state import Snapshot
from sitl.autopilot.status import mission_current
from sitl.autopilot.vehicle import Vehicle
from sitl.protocol.parameters import crc32
from sitl.protocol.service import Microservice, Reply, asker

RETRY_S, ACTION_S = 0.25, 5.0
"""Real time after which an item is asked for again, and after which an upload is given up: PX4's values. A
client lives in real time.
"""
MISSION, FENCE, RALLY = (
    mavlink.MAV_MISSION_TYPE_MISSION,
    mavlink.MAV_MISSION_TYPE_FENCE,
    mavlink.MAV_MISSION_TYPE_RALLY,
)
MOST_ITEMS = {MISSION: 2000, FENCE: 64, RALLY: 32}
"""PX4's limits."""
NAMES = {MISSION: "Mission", FENCE: "Fence", RALLY: "Rally points"}

Items = tuple[Item, ...]


class Upload:
    """An upload under way: who sends which list, and the items so far."""

    def __init__(self, partner: tuple[int, int], link: object, mission_type: int, count: int) -> None:
        """Begin without items. Stations often share their ids: a partner is known by them and by its link."""
        self.partner, self.link, self.mission_type, self.count = partner, link, mission_type, count
        self.items: list[Item] = []
        self.current = 0
        self.floats = False
        """True if the partner speaks MISSION_ITEM with floats only."""
        self.heard_s = self.asked_s = 0.0

    def ask(self, now_s: float) -> Message:
        """Return the request for the next item."""
        self.asked_s = now_s
        request = (
            mavlink.MAVLink_mission_request_message
            if self.floats
            else mavlink.MAVLink_mission_request_int_message
        )
        return request(*self.partner, len(self.items), self.mission_type)


class PlanService:
    """The lists on board of one vehicle. An upload that fails or ends half-way changes nothing."""

    def __init__(self, vehicle: Vehicle, clock: Callable[[], float] = time.monotonic) -> None:
        """Load the vehicle's mission, fence and rally points. `clock` is real time, s."""
        self._vehicle, self._clock = vehicle, clock
        self.link: object = None
        """The link over which the message came that is being answered."""
        self._items: dict[int, Items] = dict.fromkeys(MOST_ITEMS, ())
        self._upload: Upload | None = None
        self._last: Upload | None = None  # the last upload that was accepted
        self.services = (
            Microservice("MISSION_REQUEST_LIST", self._count, "MISSION_COUNT"),
            Microservice("MISSION_REQUEST_INT", self._item, "MISSION_ITEM_INT as it was uploaded"),
            Microservice("MISSION_REQUEST", self._item, "MISSION_ITEM, with floats"),
            Microservice(
                "MISSION_COUNT",
                self._begin,
                "MISSION_REQUEST_INT of the first item; with 0 items the list is cleared",
            ),
            Microservice(
                "MISSION_ITEM_INT",
                self._take,
                "the request of the next item, or MISSION_ACK; a bad item ends the upload",
            ),
            Microservice(
                "MISSION_ITEM", self._take, "the same; from then on items are requested by MISSION_REQUEST"
            ),
            Microservice("MISSION_ACK", self._end, "nothing; OPERATION_CANCELLED ends an upload"),
            Microservice("MISSION_CLEAR_ALL", self._clear, "MISSION_ACK; type 255 clears all three lists"),
            Microservice(
                "MISSION_SET_CURRENT",
                self._set_current,
                "MISSION_CURRENT; of an item that is not there MISSION_ACK",
            ),
            Microservice("MISSION_WRITE_PARTIAL_LIST", _no_part, "MISSION_ACK: unsupported", supported=False),
            Microservice(
                "MISSION_REQUEST_PARTIAL_LIST", _no_part, "MISSION_ACK: unsupported", supported=False
            ),
        )

    def next_s(self) -> float:
        """Return when to call `due` again, in real time; infinity if no upload is under way."""
        return self._upload.asked_s + RETRY_S if self._upload else math.inf

    def due(self, link: object) -> Reply:
        """Return what to send over a link now: the request of a missing item again, or the end of the
        upload.
        """
        upload, now_s = self._upload, self._clock()
        if not upload or upload.link is not link or now_s < upload.asked_s + RETRY_S:
            return Reply([])
        if now_s >= upload.heard_s + ACTION_S:
            self._upload = None
            return Reply(
                [],
                f"{NAMES[upload.mission_type]} upload given up: "
                f"no item {len(upload.items)} for {ACTION_S:g} s",
            )
        return Reply([upload.ask(now_s)])

    # ---- downloads: each request is answered by itself ----

    def _count(self, message: Message, _: float) -> Reply:
        if message.mission_type not in self._items:
            return _refused(
                message,
                mavlink.MAV_MISSION_INVALID,
                f"List refused: type {message.mission_type} is not 0, 1 or 2",
            )
        return Reply(
            [
                mavlink.MAVLink_mission_count_message(
                    *asker(message), len(self._items[message.mission_type]), message.mission_type
                )
            ]
        )

    def _item(self, message: Message, _: float) -> Reply:
        items = self._items.get(message.mission_type, ())
        if not 0 <= message.seq < len(items):
            return _refused(
                message,
                mavlink.MAV_MISSION_INVALID_SEQUENCE,
                f"No item {message.seq}: the list has {len(items)}",
            )
        item, mission_type = items[message.seq], message.mission_type
        current = mission_type == MISSION and self._vehicle.mission.current == message.seq
        head = (
            *asker(message),
            message.seq,
            item.frame,
            item.command,
            int(current),
            item.autocontinue,
            *item.params,
        )
        if message.get_type() == "MISSION_REQUEST_INT":
            return Reply(
                [mavlink.MAVLink_mission_item_int_message(*head, item.x, item.y, item.z, mission_type)]
            )
        unit = 1.0 if item.frame == mavlink.MAV_FRAME_MISSION else 1e7
        x, y = (math.nan if value == NOT_GIVEN else value / unit for value in (item.x, item.y))
        return Reply([mavlink.MAVLink_mission_item_message(*head, x, y, item.z, mission_type)])

    # ---- uploads ----

    def _begin(self, message: Message, t_s: float) -> Reply:
        mission_type = message.mission_type
        if self._upload and not self._sends(message, self._upload):
            who = "/".join(map(str, self._upload.partner))
            return _refused(message, mavlink.MAV_MISSION_ERROR, f"Upload refused: {who} is uploading")
        if mission_type not in self._items:
            return _refused(
                message, mavlink.MAV_MISSION_INVALID, f"Upload refused: type {mission_type} is not 0, 1 or 2"
            )
        if message.count > MOST_ITEMS[mission_type]:
            reason = (
                f"{NAMES[mission_type]} refused: {message.count} items, allowed are "
                f"{MOST_ITEMS[mission_type]}"
            )
            return _refused(message, mavlink.MAV_MISSION_NO_SPACE, reason)
        self._upload = upload = Upload(asker(message), self.link, mission_type, message.count)
        upload.heard_s = self._clock()
        return Reply([upload.ask(upload.heard_s)]) if message.count else self._finish(message, upload, t_s)

    def _take(self, message: Message, t_s: float) -> Reply:
        upload = self._upload
        if upload is None or not self._sends(message, upload):
            if not upload and self._last and self._is_last(message, self._last):
                return _acknowledged(message, mavlink.MAV_MISSION_ACCEPTED)  # the acknowledgement was lost
            return _refused(
                message, mavlink.MAV_MISSION_ERROR, f"Item {message.seq} refused: no upload under way"
            )
        if message.mission_type != upload.mission_type:
            return _refused(
                message,
                mavlink.MAV_MISSION_ERROR,
                f"Item {message.seq} refused: it is of type {message.mission_type}",
            )
        upload.heard_s = self._clock()
        if message.seq >= upload.count:
            self._upload = None
            reason = f"Item {message.seq} refused: the list has {upload.count}"
            return _refused(message, mavlink.MAV_MISSION_INVALID_SEQUENCE, reason)
        if message.seq != len(
            upload.items
        ):  # repeated or out of sequence: the request is repeated when it is due
            return Reply([])
        upload.floats = message.get_type() == "MISSION_ITEM"
        item = _read(message)
        try:
            if upload.mission_type == MISSION:
                plan.step(item, upload.count, self._vehicle.config)
            else:
                plan.check_point(item, upload.mission_type, self._vehicle.config)
        except BadItem as error:
            self._upload = None
            return _refused(
                message, error.code, f"{NAMES[upload.mission_type]} refused: item {message.seq}: {error}"
            )
        if message.current:
            upload.current = message.seq
        upload.items.append(item)
        return (
            Reply([upload.ask(upload.heard_s)])
            if len(upload.items) < upload.count
            else self._finish(message, upload, t_s)
        )

    def _sends(self, message: Message, upload: Upload) -> bool:
        return upload.partner == asker(message) and upload.link is self.link

    def _is_last(self, message: Message, upload: Upload) -> bool:
        same = self._sends(message, upload) and upload.mission_type == message.mission_type
        return same and message.seq == upload.count - 1 and _read(message).packed == upload.items[-1].packed

    def _finish(self, message: Message, upload: Upload, t_s: float) -> Reply:
        """Put a whole list in place of the old one."""
        self._upload = None
        try:
            self._load(upload.mission_type, tuple(upload.items), t_s, upload.current)
        except BadItem as error:
            return _refused(message, error.code, str(error))
        self._last = upload
        return _acknowledged(message, mavlink.MAV_MISSION_ACCEPTED)

    def _load(self, mission_type: int, items: Items, t_s: float, current: int = 0) -> None:
        """Load a list into the vehicle; raises BadItem if it does not fit."""
        config, number = self._vehicle.config, checksum(items)
        if mission_type == MISSION:
            if (
                number != self._vehicle.mission.number or not items
            ):  # as in PX4, the same mission again changes nothing
                self._vehicle.load(
                    t_s, tuple(plan.step(item, len(items), config) for item in items), number, current
                )
        elif mission_type == FENCE:
            fence = plan.fence(items, number, config) if items else NO_FENCE
            self._check_fence(fence, t_s)
            self._vehicle.configure(t_s, dataclasses.replace(config, fence=fence))
        else:
            rally = Rally(tuple(plan.place(item, config) for item in items), number) if items else NO_RALLY
            self._vehicle.configure(t_s, dataclasses.replace(config, rally=rally))
        self._items[mission_type] = items

    def _check_fence(self, fence: Fence, t_s: float) -> None:
        """Refuse a fence that home or a vehicle in flight lies outside of, as PX4 does."""
        state = self._vehicle.state(t_s)
        flies = state.armed and state.landed_state != mavlink.MAV_LANDED_STATE_ON_GROUND
        if not fence.allows((0.0, 0.0, 0.0)):
            raise BadItem(mavlink.MAV_MISSION_DENIED, "Fence refused: home is outside it")
        if flies and not fence.allows(state.position):
            raise BadItem(mavlink.MAV_MISSION_DENIED, "Fence refused: the vehicle is outside it")

    def _end(self, message: Message, _: float) -> Reply:
        """Take a MISSION_ACK of the partner: it may cancel its upload, or not know the kind of request."""
        upload = self._upload
        if (
            upload
            and self._sends(message, upload)
            and message.type == mavlink.MAV_MISSION_OPERATION_CANCELLED
        ):
            self._upload = None
        elif upload and self._sends(message, upload) and message.type == mavlink.MAV_MISSION_UNSUPPORTED:
            upload.floats = not upload.floats
            return Reply([upload.ask(self._clock())])
        return Reply([])

    # ---- the rest ----

    def _clear(self, message: Message, t_s: float) -> Reply:
        if self._upload and not self._sends(message, self._upload):
            return _refused(message, mavlink.MAV_MISSION_ERROR, "Clear refused: an upload is under way")
        types = (
            tuple(self._items)
            if message.mission_type == mavlink.MAV_MISSION_TYPE_ALL
            else (message.mission_type,)
        )
        if types[0] not in self._items:
            return _refused(
                message, mavlink.MAV_MISSION_INVALID, f"Clear refused: type {types[0]} is not 0, 1, 2 or 255"
            )
        self._upload = None
        for mission_type in types:
            self._load(mission_type, (), t_s)
        return _acknowledged(message, mavlink.MAV_MISSION_ACCEPTED)

    def _set_current(self, message: Message, t_s: float) -> Reply:
        result = self._vehicle.set_current(t_s, message.seq)
        if not result.accepted:
            return _refused(message, mavlink.MAV_MISSION_INVALID_SEQUENCE, result.reason)
        return Reply(
            [mission_current(Snapshot(self._vehicle.config, self._vehicle.state(t_s), (0.0, 0.0), None))]
        )


def checksum(items: Items) -> int:
    """Return PX4's id of a list: a checksum of its items, 0 of an empty one."""
    number = 0
    for item in items:
        number = crc32(item.packed, number)
    return number


def _read(message: Message) -> Item:
    """Return the item of a MISSION_ITEM_INT (73) or a MISSION_ITEM (39)."""
    x, y = message.x, message.y
    if message.get_type() == "MISSION_ITEM":
        unit = 1.0 if message.frame == mavlink.MAV_FRAME_MISSION else 1e7
        x, y = (
            round(value * unit) if abs(value) * unit < NOT_GIVEN else NOT_GIVEN for value in (x, y)
        )  # NaN is not less
    params = message.param1, message.param2, message.param3, message.param4
    return Item(message.command, message.frame, message.autocontinue, params, x, y, message.z)


def _acknowledged(message: Message, result: int) -> Reply:
    return Reply(
        [
            mavlink.MAVLink_mission_ack_message(
                *asker(message), result, getattr(message, "mission_type", MISSION)
            )
        ]
    )


def _refused(message: Message, result: int, reason: str) -> Reply:
    return Reply(_acknowledged(message, result).messages, reason)


def _no_part(message: Message, _: float) -> Reply:
    return _refused(
        message, mavlink.MAV_MISSION_UNSUPPORTED, "Partial list refused: only whole lists are taken"
    )
