"""Pictures that change many times a second on a page, over a websocket of their own: games, and agents while they train."""

from __future__ import annotations

import asyncio
import io
import secrets
import weakref
from collections.abc import Callable, Sequence

import numpy as np
from fastapi import WebSocket, WebSocketDisconnect
from nicegui import app
from nicegui.element import Element
from PIL import Image

from rejeu.core.types import JsonObject
from rejeu.teaching.play.game import Event

QUALITY = 85
"""Of a JPEG, from 1 to 95."""
CSS = """
.screen { display: flex; width: 100%; flex-wrap: wrap; gap: 12px; outline: none; }
.screen figure { margin: 0; flex: 1 1 300px; max-width: 720px; }
.screen figcaption { display: flex; gap: 12px; align-items: baseline; overflow-wrap: anywhere; }
.screen figcaption small { margin-left: auto; opacity: 0.7; }
.screen canvas { display: block; width: 100%; border: 1px solid #8886; }
.screen canvas.small { image-rendering: pixelated; }
.screen p { margin: 4px 0; min-height: 1.5em; text-align: center; font-weight: 600; }
.screen .won p { color: #26965f; }
"""
KEYS = {
    "arrowleft": "left",
    "arrowright": "right",
    "arrowup": "up",
    "arrowdown": "down",
    " ": "space",
    "enter": "return",
}
KEYS |= {"shift": "left shift", "control": "left ctrl", "right control": "right ctrl"}
"""SDL's names of keys by those of browsers, where they differ."""
_open: weakref.WeakValueDictionary[str, Screen] = weakref.WeakValueDictionary()


class Screen(Element, component="screen.js"):
    """Pictures side by side. Mutable: ``show`` replaces them; it may be called from any thread.

    A browser that is slow leaves out pictures.

    Args:
        key: called with what the keyboard does, with SDL's names of keys.
    """

    def __init__(self, key: Callable[[Event], object] | None = None) -> None:
        super().__init__()
        self._key = key
        self._newest: tuple[Sequence[bytes], JsonObject] = (), {}
        self._changed, self._loop = asyncio.Event(), asyncio.get_running_loop()
        self.on_leave: Callable[[], object] = lambda: None
        """Called when the page is closed, or the element removed."""
        channel = secrets.token_urlsafe(12)
        self.props.update(channel=channel, keys=key is not None)
        _open[channel] = self

    def show(self, pictures: Sequence[np.ndarray], captions: Sequence[JsonObject], presses: int = 0) -> None:
        """Shows pictures, ``uint8 (height, width, 3)``.

        Captions are texts: ``name``, ``score``, ``about`` and ``message``; ``won`` colors the message. ``presses`` says how
        many keys had been pressed before.
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


def key_name(name: str) -> str:
    """Returns SDL's name of a key from that of a browser.

    >>> [key_name(name) for name in ("ArrowLeft", "A", " ", "right Shift")]
    ['left', 'a', 'space', 'right shift']
    """
    return KEYS.get(name.lower(), name.lower())


@app.websocket("/screen/{channel}")
async def answer(socket: WebSocket, channel: str) -> None:
    """Connects a browser with the screen on its page."""
    screen = _open.get(channel)
    if screen is None:
        await socket.close(1008)
        return
    await socket.accept()
    await screen.serve(socket)
