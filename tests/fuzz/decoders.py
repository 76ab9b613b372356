"""The decoders that are fuzzed: each with real inputs to begin with, and a check that holds for any bytes."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from tests.fuzz import files, plumes, services, watchers


class Decoder(NamedTuple):
    """One decoder."""

    seeds: Callable[[], Sequence[bytes]]
    check: Callable[[bytes], None]
    """Raises on any input for which a promise is broken: whatever it raises is a find."""


DECODERS = {
    "reading": Decoder(services.reading_seeds, services.reading),
    "belief": Decoder(services.belief_seeds, services.belief),
    "stop": Decoder(services.stop_seeds, services.stop),
    "waypoint": Decoder(services.mavlink_in_seeds, services.waypoint),
    "plan": Decoder(services.plan_seeds, services.plan),
    "departure": Decoder(services.departure_seeds, services.departure),
    "latecomer": Decoder(services.latecomer_seeds, services.latecomer),
    "mavlink-in": Decoder(services.mavlink_in_seeds, services.mavlink_in),
    "clients": Decoder(services.clients_seeds, services.clients),
    "frames": Decoder(services.frames_seeds, services.frames),
    "health": Decoder(watchers.health_seeds, watchers.heard),
    "messages": Decoder(watchers.messages_seeds, watchers.messages),
    "recording": Decoder(watchers.messages_seeds, watchers.recording),
    "browser": Decoder(watchers.browser_seeds, watchers.browser),
    "viewer": Decoder(watchers.viewer_seeds, watchers.viewer),
    "record": Decoder(files.record_seeds, files.record),
    "tlog": Decoder(files.tlog_seeds, files.tlog),
    "dataflash": Decoder(files.dataflash_seeds, files.onboard),
    "ulog": Decoder(files.ulog_seeds, files.onboard),
    "table": Decoder(files.table_seeds, files.table),
    "script": Decoder(files.script_seeds, files.script),
    "bundle": Decoder(files.bundle_seeds, files.zipped),
    "bundle-page": Decoder(files.page_of_bundle_seeds, files.page_of_bundle),
    "bundle-graph": Decoder(files.graph_seeds, files.graph),
    "rows": Decoder(files.rows_seeds, files.rows),
    "gaden": Decoder(plumes.iteration_seeds, plumes.iteration),
    "gaden-packed": Decoder(plumes.packed_iteration_seeds, plumes.packed_iteration),
    "gaden-walls": Decoder(plumes.walls_seeds, plumes.walls),
    "gaden-wind": Decoder(plumes.wind_seeds, plumes.gaden_wind),
    "npy": Decoder(plumes.npy_seeds, plumes.npy_movie),
    "zarr-array": Decoder(plumes.zarr_array_seeds, plumes.zarr_array),
    "zarr-said": Decoder(plumes.zarr_attributes_seeds, plumes.zarr_attributes),
    "zarr-chunk": Decoder(plumes.zarr_chunk_seeds, plumes.zarr_chunk),
    "sidecar": Decoder(plumes.sidecar_seeds, plumes.sidecar),
}
"""By name."""
