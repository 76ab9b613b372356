"""Services as threads of the test's process: real command lines on a real bus, without the start-up time
of processes.
"""

import contextlib
import importlib
import queue
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import pytest

import agent.__main__
import sitl.__main__
from link.bus.inbox import Inbox
from link.bus.session import Bus

END = object()


class Services:
    """The services on one router; they end with the `with` block."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, router: str) -> None:
        self._monkeypatch = monkeypatch
        self._router = router
        self._ready: queue.SimpleQueue[Inbox] = queue.SimpleQueue()
        self._running: list[tuple[Inbox, threading.Thread]] = []

    def __enter__(self) -> "Services":
        return self

    def __exit__(self, *_: object) -> None:
        for inbox, thread in self._running:
            inbox.put(END)
            thread.join()

    def start(self, parts: Mapping[str, Sequence[str]]) -> None:
        """Start `python -m part words` for each part."""
        for part, words in parts.items():
            module = importlib.import_module(f"{part}.__main__")
            self._monkeypatch.setattr(module, "Bus", self._bus())
            self._monkeypatch.setattr(sys, "argv", [part, "--connect", self._router, *words])
            thread = threading.Thread(target=_serve, args=(module.main,))
            thread.start()
            self._running.append((self._ready.get(timeout=400), thread))

    def _bus(self) -> type[Bus]:
        ready = self._ready

        class Mortal(Bus):
            """Reports when its service is ready, and ends the service on request."""

            told = False

            def __init__(self, *words: Any, **settings: Any) -> None:
                self.inbox = settings.setdefault("inbox", Inbox())
                super().__init__(*words, **settings)

            def publish_health(self) -> None:
                super().publish_health()
                if not self.told:
                    self.told = True
                    ready.put(self.inbox)

            def receive(self, timeout_s: float | None = None) -> Any:
                if (item := super().receive(timeout_s)) is END:
                    raise SystemExit
                return item

        return Mortal


def _serve(main: Callable[[], object]) -> None:
    with contextlib.suppress(SystemExit):
        main()


def run_sitl(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: str
) -> tuple[int, list[str], list[str]]:
    """Run `python -m sitl arguments` in this process; returns its status and the lines of its stdout and
    stderr.
    """
    return _run(sitl.__main__.main, monkeypatch, capsys, "sitl", *arguments)


def run_agent(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: str
) -> tuple[int, list[str], list[str]]:
    """Run `python -m agent arguments` in this process; returns its status and the lines of its stdout and
    stderr.
    """
    return _run(agent.__main__.main, monkeypatch, capsys, "agent", *arguments)


def _run(
    main: Callable[[], int | None],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    *words: str,
) -> tuple[int, list[str], list[str]]:
    capsys.readouterr()
    monkeypatch.setattr(sys, "argv", [*words])
    try:
        status = main() or 0
    except SystemExit as end:
        status = int(str(end.code))
    out, err = capsys.readouterr()
    return status, out.splitlines(), err.splitlines()
