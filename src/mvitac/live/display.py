"""A window for live input: the newest frames, contact, and the model's answers, as one picture.

``draw`` needs neither a display nor OpenCV, so it can be tested; ``Window`` needs both, and its error names the missing one.
"""

import os
import sys
from types import ModuleType

import numpy as np
from PIL import Image, ImageDraw, ImageOps

from mvitac.data.image_grid import font
from mvitac.data.spec import task_title
from mvitac.live.predictor import Live
from mvitac.system.files import brief

SIDE, LINE, EDGE = 256, 24, 4
"""Pixels: side of a stream's picture, height of a line of text, width of the frame around a picture."""
BACK, TEXT, FAINT = (24, 24, 28), (235, 235, 235), (130, 130, 130)
TOUCHED, FAULT = (60, 170, 90), (200, 60, 50)


def draw(loop: Live) -> np.ndarray:
    """uint8 RGB [H, W, 3] of fixed size: streams side by side (green frame: contact, red: fault), answers below."""
    width = SIDE * max(2, len(loop.all))
    touch = loop.touch or loop.last
    answers = loop.answers(touch)
    rows = 2 + len(loop.engine.classes) + sum(map(len, loop.engine.values.values()))
    picture = Image.new("RGB", (width, SIDE + LINE * rows), BACK)
    pen, face = ImageDraw.Draw(picture), font(13)
    for i, stream in enumerate(loop.all):
        left, state = i * SIDE, loop.state(stream)
        touched = stream.name in loop.contacts and loop.contacts[stream.name].touched
        frame = FAULT if stream.fault else TOUCHED if touched else BACK
        pen.rectangle((left, 0, left + SIDE - 1, SIDE - 1), fill=frame)
        if newest := stream.newest(take=False):
            inner = (SIDE - 2 * EDGE, SIDE - 2 * EDGE)
            picture.paste(ImageOps.pad(Image.fromarray(newest.image), inner, color=BACK), (left + EDGE, EDGE))
        text = f"{stream.name}  {stream.rate():.0f} fps  {'CONTACT' if touched and not stream.fault else state}"
        pen.text((left + EDGE, SIDE + 3), text, frame if stream.fault else TEXT, face)
    for row, (task, (name, confidence)) in enumerate(answers.items()):
        top, sure = SIDE + LINE * (1 + row), confidence >= loop.config.min_confidence
        pen.rectangle((width // 2, top + 5, width // 2 + round(confidence * (width // 2 - 60)), top + LINE - 5), FAINT)
        answer = f"{task_title(task, loop.engine.classes[task])}: {name}{'' if sure else ' (unsure)'}"
        pen.text((EDGE, top + 3), answer, TEXT if sure else FAINT, face)
        pen.text((width - 50, top + 3), f"{100 * confidence:.0f} %", TEXT if sure else FAINT, face)
    values = [reading for found in loop.readings(touch).values() for reading in found]
    for row, reading in enumerate(values, len(answers)):
        pen.text((EDGE, SIDE + LINE * (1 + row) + 3), f"{reading.name}: {reading}", TEXT, face)
    if touch and touch.known:
        pen.text((EDGE, picture.height - LINE + 3), "like: " + "; ".join(touch.known), TEXT, face)
    return np.asarray(picture)


class Window:
    """A window of the desktop that shows pictures until it is closed, or q or Esc is pressed in it."""

    def __init__(self, title: str = "mvitac live") -> None:
        """ValueError names what a window needs and is missing."""
        self.title, self.cv2 = title, _opencv()
        try:
            self.cv2.namedWindow(title)
        except self.cv2.error as error:
            raise ValueError(f"--window: OpenCV cannot open one ({brief(error)}): leave it out") from None

    def show(self, picture: np.ndarray) -> bool:
        """Show uint8 RGB [H, W, 3]; False if the user has closed the window."""
        self.cv2.imshow(self.title, np.ascontiguousarray(picture[..., ::-1]))  # OpenCV wants BGR
        pressed = self.cv2.waitKey(1) & 0xFF
        return pressed not in (ord("q"), 27) and self.cv2.getWindowProperty(self.title, self.cv2.WND_PROP_VISIBLE) >= 1

    def close(self) -> None:
        self.cv2.destroyAllWindows()


def _opencv() -> ModuleType:
    """OpenCV, or ValueError if it cannot open windows here."""
    # Checked first: some builds of OpenCV end the process without a display.
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ValueError("--window: there is no display (DISPLAY and WAYLAND_DISPLAY are not set): leave it out")
    try:
        import cv2
    except ImportError:
        raise ValueError("--window needs OpenCV: pip install opencv-python") from None
    if not cv2.currentUIFramework():
        raise ValueError(
            "--window: this OpenCV has no windows (opencv-python-headless): install opencv-python in its place,"
            " or leave it out"
        )
    return cv2
