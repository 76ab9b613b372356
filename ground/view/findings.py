"""The findings of a shown record: a page that `plumeward findings` writes when somebody asks for it."""

import asyncio
import contextlib
import sys
import tempfile
from pathlib import Path

from starlette.responses import HTMLResponse, PlainTextResponse, Response

# The page has styles of its own and loads nothing. `ground/findings/page.py` says so in it, too.
POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
LONGEST_S = 300.0  # a record that takes longer has findings by the command only
PAGE = "findings.html"


class FindingsOfRecords:
    """Makes findings, one record at a time, and keeps them: a record does not change."""

    def __init__(self) -> None:
        self._made: dict[Path, str] = {}
        self._turn = asyncio.Lock()

    async def page(self, record: Path) -> Response:
        """Return the page of a record's findings, or the line that says why there is none."""
        async with self._turn:
            if record not in self._made:
                with tempfile.TemporaryDirectory() as folder:
                    why_not = await _write(record, Path(folder))
                    try:
                        self._made[record] = Path(folder, PAGE).read_text(encoding="utf-8")
                    except FileNotFoundError:
                        return PlainTextResponse(f"no findings: {why_not}\n", 503)
        return HTMLResponse(self._made[record], headers={"content-security-policy": POLICY})


async def _write(record: Path, folder: Path) -> str:
    """Let the command write a record's findings into a folder; returns its last line."""
    part = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "sitl", "findings", str(record), "--out", str(folder)),
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.PIPE,
    )
    try:
        async with asyncio.timeout(LONGEST_S):
            _, said = await part.communicate()
    except TimeoutError:
        return f"they took longer than {LONGEST_S:g} s; `plumeward findings` has no such limit"
    finally:
        with contextlib.suppress(ProcessLookupError):
            part.kill()
    return (said.decode(errors="replace").strip().splitlines() or ["it was ended"])[-1]
