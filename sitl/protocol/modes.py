"""The service of standard modes: which flight modes there are (AVAILABLE_MODES)."""

from aircraft.mode import Mode
from link.bus.mavlink import Message
from link.bus.px4 import AvailableModes

MODES = tuple(Mode)


def available_modes(index: int) -> list[Message]:
    """Return AVAILABLE_MODES (435) of one mode, numbered from 1, or with 0 of all. Empty if there is no
    such mode.
    """
    return [
        AvailableModes(
            custom_mode=mode.custom_mode,
            properties=0,
            number_modes=len(MODES),
            mode_index=number,
            standard_mode=mode.standard,
            mode_name=mode.name.capitalize().encode(),
        )
        for number, mode in enumerate(MODES, start=1)
        if index in (0, number)
    ]
