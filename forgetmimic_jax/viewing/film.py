"""Films of episodes: the policies' panes side by side with captions burnt in, as MP4, GIF and a contact sheet."""

from __future__ import annotations

import functools
import io
import math
from collections.abc import Iterable, Iterator, Sequence

import av
import numpy as np
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import gaussian_filter1d

from forgetmimic_jax.viewing.offscreen import Renderer
from forgetmimic_jax.viewing.takes import Episode, at, facing

FPS = 25.0  # of a film
PANE = (400, 400)  # width and height of one policy's pane, pixels
HEADER = 36  # pixels above the panes
FRONT_LEFT = 215.0  # degrees from the robot's heading at the start to the camera's gaze
SMOOTH_SECONDS = 0.25  # width of the Gaussian that smooths the camera's path
LEAN = 0.5  # m, how far the camera looks from the robot towards the reference
INK, PAPER, GREY = (28, 32, 38), (255, 255, 255), (110, 118, 128)
RED, GREEN, TARGET = (208, 32, 42), (30, 122, 70), (176, 84, 0)
BORDER = 5  # pixels of the red frame after a fall
GAP = 6  # pixels between the stills of a contact sheet


def pane_renderer(robot: str) -> Renderer:
    """The renderer that `render_clip` draws its panes with."""
    return Renderer(robot, *PANE)


def shown_steps(episode: Episode, *, fps: float = FPS, seconds: float = math.inf) -> range:
    """The steps of an episode that make its film: thinned to `fps`.

    Args:
        episode: to be shown.
        fps: pictures a second.
        seconds: longest film.
    """
    last = len(episode.reference) - 1
    return range(0, int(min(last, seconds * episode.fps)) + 1, max(1, round(episode.fps / fps)))


def render_clip(
    renderer: Renderer, episode: Episode, *, fps: float = FPS, seconds: float = math.inf
) -> Iterator[np.ndarray]:
    """The film of an episode, frame by frame.

    Args:
        renderer: from `pane_renderer`.
        episode: what `record` returned for one clip.
        fps: pictures a second; the episode's steps are thinned to it.
        seconds: longest film; it ends sooner where the episode does.

    Yields:
        [height, width, 3] u8: a header, and below it one pane a policy.
    """
    paths = {name: _camera_path(take.qpos, episode.reference, episode.fps) for name, take in episode.takes.items()}
    azimuth = math.degrees(facing(episode.reference[0])) + FRONT_LEFT
    for step in shown_steps(episode, fps=fps, seconds=seconds):
        frame = Image.new("RGB", (PANE[0] * len(episode.takes), PANE[1] + HEADER), PAPER)
        _header(frame, episode, step)
        for column, name in enumerate(episode.takes):
            pane = _pane(renderer, name, episode, step, paths[name][step], azimuth)
            frame.paste(pane, (column * PANE[0], HEADER))
        yield np.asarray(frame)


def stills(frames: Sequence[np.ndarray], count: int) -> list[np.ndarray]:
    """`count` frames of a film, evenly spread from the first to the last, at half the size."""
    chosen = np.linspace(0, len(frames) - 1, count).round().astype(int)
    return [np.asarray(Image.fromarray(frames[index]).reduce(2)) for index in chosen]


def contact_sheet(rows: Sequence[Sequence[np.ndarray]]) -> bytes:
    """A PNG with a row of pictures [height, width, 3] a clip; every row has as many, of the same size."""
    height, width, _ = rows[0][0].shape
    sheet = Image.new("RGB", (len(rows[0]) * (width + GAP) - GAP, len(rows) * (height + GAP) - GAP), PAPER)
    for i, row in enumerate(rows):
        for j, picture in enumerate(row):
            sheet.paste(Image.fromarray(picture), (j * (width + GAP), i * (height + GAP)))
    buffer = io.BytesIO()
    sheet.save(buffer, format="PNG")
    return buffer.getvalue()


def mp4(frames: Iterable[np.ndarray], fps: float = FPS) -> bytes:
    """Frames [height, width, 3] u8 as an H.264 film in an MP4 container."""
    buffer = io.BytesIO()
    with av.open(buffer, "w", format="mp4") as container:
        stream = None
        for frame in frames:
            if stream is None:
                stream = container.add_stream("libx264", rate=round(fps), options={"crf": "23", "preset": "medium"})
                stream.height, stream.width = frame.shape[:2]
                stream.pix_fmt = "yuv420p"
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        if stream is not None:
            container.mux(stream.encode(None))
    return buffer.getvalue()


def poster(film: bytes) -> bytes:
    """A JPEG of the picture in the middle of an MP4: what stands for the film on paper, and until it plays."""
    with av.open(io.BytesIO(film), "r") as container:
        pictures = [picture.to_image() for picture in container.decode(video=0)]
    buffer = io.BytesIO()
    pictures[len(pictures) // 2].save(buffer, format="JPEG", quality=85)
    return buffer.getvalue()


def gif(frames: Sequence[np.ndarray], fps: float = FPS) -> bytes:
    """Every second frame, half as wide and high, as an endless GIF."""
    images = [Image.fromarray(frame).reduce(2) for frame in frames[::2]]
    # One palette for all: the colours of a picture early, one in the middle and one late.
    probe = np.concatenate([np.asarray(images[i]) for i in (0, len(images) // 2, -1)])
    palette = Image.fromarray(probe).quantize(128)
    indexed = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    buffer = io.BytesIO()
    indexed[0].save(buffer, format="GIF", save_all=True, append_images=indexed[1:], duration=round(2000 / fps), loop=0)
    return buffer.getvalue()


def _pane(
    renderer: Renderer, name: str, episode: Episode, step: int, look_at: np.ndarray, azimuth: float
) -> Image.Image:
    take = episode.takes[name]
    image = Image.fromarray(renderer.picture(take.qpos[step], episode.reference[step], look_at, azimuth))
    pen = ImageDraw.Draw(image, "RGBA")
    width, height = PANE
    _chip(pen, (10, 10), name.replace("_", " "), INK)
    ended = take.ended is not None and step >= take.ended
    fell = take.fell is not None and step >= take.fell
    rewards = take.tracking_reward
    reward = 0.0 if ended else float(rewards[min(step, len(rewards) - 1)])
    text = f"tracking {reward:.2f}"
    pen.rectangle([10, height - 20, width - 10, height - 12], fill=(255, 255, 255, 170))
    pen.rectangle([10, height - 20, 10 + (width - 20) * reward, height - 12], fill=(46, 140, 90, 255))
    pen.text((10, height - 26), text, font=_font(15), fill=INK, anchor="ls")
    pen.rectangle([0, 0, width - 1, height - 1], outline=PAPER)
    follows, stands = at(episode, name, step)
    if fell:
        pen.rectangle([0, 0, width - 1, height - 1], outline=RED, width=BORDER)
    if ended:
        _chip(pen, (width - 10, 10), follows, INK, right=True)
    if ended or fell:
        _chip(pen, (width - 10, 40), stands, RED if fell else GREEN, right=True)
    return image


def _header(frame: Image.Image, episode: Episode, step: int) -> None:
    pen = ImageDraw.Draw(frame)
    middle = HEADER // 2
    pen.text((10, middle), episode.clip, font=_font(19), fill=INK, anchor="lm")
    if episode.target:
        left = 10 + pen.textlength(episode.clip, font=_font(19)) + 12
        pen.text((left, middle), "to be forgotten", font=_font(16), fill=TARGET, anchor="lm")
    time = f"{step / episode.fps:.2f} s"
    pen.text((frame.width - 10, middle), time, font=_font(16), fill=GREY, anchor="rm")


def _chip(pen: ImageDraw.ImageDraw, corner: tuple[int, int], text: str, colour: tuple[int, ...], right=False) -> None:
    """White text on a rounded patch whose upper left, or with `right` upper right, corner is given."""
    font = _font(15)
    width = pen.textlength(text, font=font) + 16
    left = corner[0] - width if right else corner[0]
    pen.rounded_rectangle([left, corner[1], left + width, corner[1] + 25], radius=6, fill=(*colour, 225))
    pen.text((left + 8, corner[1] + 12), text, font=font, fill=PAPER, anchor="lm")


@functools.cache
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)


def _camera_path(qpos: np.ndarray, reference: np.ndarray, fps: float) -> np.ndarray:
    """Where to look, [step, 2] m: between robot and reference but near the robot, and smooth, whatever it does."""
    apart = 0.5 * (reference[:, :2] - qpos[:, :2])
    distance = np.linalg.norm(apart, axis=1, keepdims=True)
    towards = apart * np.minimum(1.0, LEAN / np.maximum(distance, 1e-9))
    return gaussian_filter1d(qpos[:, :2] + towards, SMOOTH_SECONDS * fps, axis=0, mode="nearest")
