"""The folder of a training run: its recipe and its checkpoints.

A lock lets one process at a time train in it.
"""

import fcntl
from contextlib import ExitStack
from pathlib import Path
from typing import IO

import msgspec

from agent.learn.train.recipes import Recipe


def claim(folder: Path, recipe: Recipe, seed: int) -> IO[bytes]:
    """Reserve a folder for a run until the returned file is closed.

    Raises ValueError if another process trains in it or if it holds another run, and OSError.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "recipe.json"
    kept = [*checkpoints(folder), *sorted(folder.glob("*.zip"))]
    if kept and not path.exists():
        raise ValueError(f"{str(folder)!r} holds {kept[0].name} but no recipe.json; wanted an empty folder")
    said = msgspec.json.format(msgspec.json.encode({"seed": seed, "recipe": recipe}))
    with ExitStack() as on_error:
        file = on_error.enter_context(path.open("a+b"))
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ValueError(
                f"another process trains in {str(folder)!r}; choose another folder, or wait until it ends"
            ) from None
        file.seek(0)
        if file.read() != said:
            if kept:
                raise ValueError(
                    f"{str(folder)!r} holds a run of another recipe or seed; wanted an empty folder, or the "
                    "command of that run"
                )
            file.truncate(0)
            file.write(said)
            file.flush()
        on_error.pop_all()
    return file


def checkpoints(folder: Path) -> list[Path]:
    """Return the checkpoints of a run, the oldest first."""
    return sorted(folder.glob("checkpoint-[0-9]*"))
