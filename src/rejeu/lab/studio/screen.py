"""Pictures that change many times a second on a page, over a websocket of their own: games, and agents while they train."""

from __future__ import annotations

import asyncio
import io
import re
import secrets
import weakref
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from fastapi import WebSocket, WebSocketDisconnect
from nicegui import app
from nicegui.element import Element
from PIL import Image

from rejeu.core.types import JsonObject
from rejeu.teaching.play.game import Event

QUALITY = 85
"""Of a JPEG, from 1 to 95."""
CSS = Path(__file__).with_suffix(".css")
"""Style of a screen; on pages of the class ``fits`` the pictures give way to all else, so that they fit the window."""
KEYS = {"enter": "return", "numpadenter": "return", "space": "space", " ": "space"}
KEYS |= {
    f"{name}{side}": f"{side} {key}"
    for side in ("left", "right")
    for name, key in (("shift", "shift"), ("control", "ctrl"))
}
KEYS |= {f"arrow{side}": side for side in ("left", "right", "up", "down")}
KEYS |= dict(zip(("comma", "period", "semicolon", "quote", "minus", "equal"), ",.;'-=", strict=True))
KEYS |= dict(zip(("bracketleft", "bracketright", "backslash", "slash", "backquote"), "[]\\/`", strict=True))
"""SDL's names of keys by the codes of browsers in lower case, where they differ."""
_open: weakref.WeakValueDictionary[str, Screen] = weakref.WeakValueDictionary()


class Screen(Element, component="screen.js"):
    """Pictures side by side. Mutable: ``show`` replaces them; it may be called from any thread.

    A browser that is slow leaves out pictures.

    Args:
        key: called with what the keyboard does, with SDL's names of keys.
        labels: called with what stands on the keys of the keyboard, by SDL's names.
    """

    def __init__(
        self, key: Callable[[Event], object] | None = None, labels: Callable[[dict[str, str]], object] | None = None
    ) -> None:
        super().__init__()
        self._key = key
        self._newest: tuple[Sequence[bytes], JsonObject] = (), {}
        self._changed, self._loop = asyncio.Event(), asyncio.get_running_loop()
        self.on_leave: Callable[[], object] = lambda: None
        """Called when the page is closed, or the element removed."""
        channel = secrets.token_urlsafe(12)
        self.props.update(channel=channel, keys=key is not None)
        _open[channel] = self
        if labels is not None:
            self.on("labels", lambda event: labels({key_name(code): str(text) for code, text in event.args.items()}))

    def show(self, pictures: Sequence[np.ndarray], captions: Sequence[JsonObject], presses: int = 0) -> None:
        """Shows pictures, ``uint8 (height, width, 3)``.

        Captions are texts: ``name``, ``score``, ``about`` and ``message``; ``won`` colors the message, and ``bars`` are dicts
        of :class:`rejeu.lab.studio.deciding.Bar`. ``presses`` says how many keys had been pressed before.
        """
        self._newest = [jpeg(picture) for picture in pictures], {"captions": captions, "presses": presses}
        self._loop.call_soon_threadsafe(self._changed.set)

    def _handle_delete(self) -> None:
        self.on_leave()
        super()._handle_delete()

    async def serve(self, socket: WebSocket) -> None:
        """Sends each picture when the one before it was drawn, until the browser is gone."""
        self._changed.set()
        drawn = asyncio.Event()
        sending = asyncio.create_task(self._send(socket, drawn))
        try:
            while True:
                event_type, name = await socket.receive_json()
                if event_type == "shown":
                    drawn.set()
                elif self._key is not None and event_type in ("press", "release", "leave"):
                    self._key(Event(event_type, key_name(str(name))))
        except (WebSocketDisconnect, ValueError, TypeError):
            return
        finally:
            sending.cancel()
            if self._key is not None:
                self._key(Event("leave"))

    async def _send(self, socket: WebSocket, drawn: asyncio.Event) -> None:
        while True:
            await self._changed.wait()
            self._changed.clear()
            pictures, texts = self._newest
            if pictures:
                await socket.send_json(texts)
                for picture in pictures:
                    await socket.send_bytes(picture)
                await drawn.wait()
                drawn.clear()


def jpeg(picture: np.ndarray) -> bytes:
    """Returns a picture as a JPEG."""
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "JPEG", quality=QUALITY)
    return file.getvalue()


def key_name(code: str) -> str:
    """Returns SDL's name of a key from a browser's code of its place, which is that of the key there on a US keyboard.

    >>> [key_name(code) for code in ("ArrowLeft", "KeyA", "Digit7", "Numpad7", "Space", "ShiftRight", "Slash")]
    ['left', 'a', '7', '7', 'space', 'right shift', '/']
    """
    name = re.sub(r"^(key|digit|numpad)(?=.$)", "", code.lower())
    return KEYS.get(name, name)


@app.websocket("/screen/{channel}")
async def answer(socket: WebSocket, channel: str) -> None:
    """Connects a browser with the screen on its page."""
    screen = _open.get(channel)
    if screen is None:
        await socket.close(1008)
        return
    await socket.accept()
    await screen.serve(socket)
