"""The flight modes, as the search and the simulated vehicle know them."""

from link.modes import Mode as Mode
