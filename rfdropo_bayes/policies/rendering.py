"""A picture of a lane: trunk, cables, cube on its plate, goal and its distance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from rfdropo_bayes.report.motion import CUBE_FACES, cube_corners, silhouette, smooth_line, tube, tube_faces, upright

if TYPE_CHECKING:
    from rfdropo_bayes.policies.episodes import Episodes

WIDTH, HEIGHT, FINER = 640, 480, 2  # size of a picture, and how much finer it is drawn before it is scaled down
FOREGROUND = {
    "trunk": (86, 140, 196),
    "cube": (232, 163, 61),
    "goal": (205, 60, 60),
    "long cable": (60, 60, 60),
    "short cable": (120, 90, 150),
}
PAPER, PLATE, GRID, INK = (250, 250, 250), (232, 232, 228), (205, 205, 200), (40, 40, 40)
LIGHT = np.array([0.35, -0.45, 0.82]) / np.linalg.norm([0.35, -0.45, 0.82])
GOAL_RADIUS = 0.004
THICKNESS = 0.03  # radius over length of the line that is drawn through the markers of a black box


class View(NamedTuple):
    """An oblique view without perspective, so that lengths can be compared."""

    centre: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]  # right, up and towards the eye
    scale: float  # pixels per metre

    def place(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Pixel coordinates and depth of points."""
        seen = (np.asarray(points) - self.centre) @ self.axes.T
        x = 0.5 * FINER * WIDTH + self.scale * seen[..., 0]
        y = 0.5 * FINER * HEIGHT - self.scale * seen[..., 1]
        return np.stack([x, y, seen[..., 2]], axis=-1)


def view_of(low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]) -> View:
    """A view from the front right and above that shows a box whole."""
    azimuth, elevation = np.radians(-52.0), np.radians(22.0)
    eye = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    right = np.cross([0.0, 0.0, 1.0], eye)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(eye, right), eye])
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    centre = 0.5 * (low + high)
    extent = np.abs((corners - centre) @ axes[:2].T).max(axis=0)
    scale = 0.44 * FINER * min(WIDTH / extent[0], HEIGHT / extent[1])
    return View(centre, axes, float(scale))


def picture(episodes: Episodes, lane: int) -> UInt8[np.ndarray, "height width 3"]:
    """Picture of a lane's present state."""
    robot = episodes.robot
    turn = upright(robot.gravity)
    line, width = _body(episodes, lane)
    line = line @ turn.T
    goal = turn @ episodes.goal[lane]
    low, high = _stage(episodes, turn)
    view = view_of(low, high)
    image = Image.new("RGB", (FINER * WIDTH, FINER * HEIGHT), PAPER)
    draw = ImageDraw.Draw(image, "RGBA")
    push = robot.push
    floor = push.plate_height_m if push is not None and episodes.pose is not None else low[2]
    _draw_floor(draw, view, low, high, floor)
    _draw_shadow(draw, view, line, width, floor)
    faces = _tube_faces(line, width)
    if episodes.pose is not None:
        side = episodes.parameters[lane].get("cube_side", push.parameters["cube_side"].nominal if push else 0.035)
        corners = cube_corners(episodes.pose[lane][None], side)[0] @ turn.T
        faces += [(corners[index], FOREGROUND["cube"]) for index in CUBE_FACES]
    faces += _goal_faces(goal)
    _draw_faces(draw, view, faces)
    if robot.body is not None:
        _draw_cables(draw, view, episodes, line, turn)
    _draw_goal_line(draw, view, goal, floor)
    _caption(draw, episodes, lane)
    return np.asarray(image.resize((WIDTH, HEIGHT), Image.Resampling.LANCZOS))


def frames_of(
    episodes: Episodes,
    actions: Float[np.ndarray, "action size"],
    parameters: Mapping[str, float],
    goal: Sequence[float],
) -> list[UInt8[np.ndarray, "height width 3"]]:
    """Replay an episode: a picture before every action and a final picture.

    Args:
        episodes: lanes of the same task; all of them are reset.
        actions: actions of the episode; ``parameters`` [SI] and ``goal`` [m]: its start.
    """
    option = {"parameters": dict(parameters), "goal": list(goal)}
    episodes.reset(np.arange(episodes.lanes), [option] * episodes.lanes)
    frames = [picture(episodes, 0)]
    for action in actions:
        episodes.act(np.repeat(np.asarray(action)[None], episodes.lanes, axis=0))
        frames.append(picture(episodes, 0))
    return frames


def _body(episodes: Episodes, lane: int) -> tuple[Float[np.ndarray, "point 3"], Float[np.ndarray, " point"]]:
    """Centre line from the clamp to the tip, and the radius along it."""
    robot = episodes.robot
    if robot.body is None:
        line = _straight(episodes, lane)
        return line, np.full(len(line), THICKNESS * _reach(line))
    rest = robot.marker_points()[:, 2]
    order = np.argsort(rest)
    marker, heights = episodes.marker[lane][order], rest[order]
    station, half = np.asarray(robot.body.station_m), np.mean(robot.body.half_width_m, axis=1)
    if heights[0] > station[0] + 1e-6:
        marker = np.concatenate([[[0.0, 0.0, station[0]]], marker])
        heights = np.concatenate([[station[0]], heights])
    line, at = smooth_line(marker[None], heights, points=90)
    return line[0], np.interp(at, station, half)


def _stage(episodes: Episodes, turn: Float[np.ndarray, "3 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the box that is shown: reach of the trunk, goals, cube and plate."""
    task, robot = episodes.task, episodes.robot
    goals = [list(task.goal_low), list(task.goal_high)]
    if robot.body is None:
        reach = _reach(_straight(episodes, 0))
        corners = np.array([[-reach, -reach, -reach], [reach, reach, reach], *goals]) @ turn.T
        return corners.min(axis=0), corners.max(axis=0)
    length = float(robot.body.station_m[-1])
    reach = 0.55 * length
    corners = np.array([[-reach, -reach, 0.0], [reach, 0.4 * reach, 1.02 * length], *goals]) @ turn.T
    return corners.min(axis=0), corners.max(axis=0)


def _straight(episodes: Episodes, lane: int) -> Float[np.ndarray, "point 3"]:
    """From the base through the markers, which are all that is known of a black box."""
    corners = np.concatenate([np.zeros((1, 3)), episodes.marker[lane]])
    at = np.linspace(0.0, len(corners) - 1.0, 20 * (len(corners) - 1) + 1)
    return np.stack([np.interp(at, np.arange(len(corners)), corners[:, axis]) for axis in range(3)], axis=1)


def _reach(line: Float[np.ndarray, "point 3"]) -> float:
    """Length of a line [m], rounded up to steps of a tenth so that pictures of one robot have one scale."""
    length = max(1e-3, float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum()))
    return float(1.1 ** np.ceil(np.log(length) / np.log(1.1)))


def _tube_faces(line: np.ndarray, width: np.ndarray) -> list[tuple[np.ndarray, tuple[int, int, int]]]:
    rings = tube(line, width)
    points = rings.reshape(-1, 3)
    faces = [(points[index], FOREGROUND["trunk"]) for index in tube_faces(len(line))]
    return [*faces, (rings[-1][:-1], FOREGROUND["trunk"])]


def _goal_faces(goal: np.ndarray) -> list[tuple[np.ndarray, tuple[int, int, int]]]:
    """A small ball."""
    polar, around = np.linspace(0.0, np.pi, 9), np.linspace(0.0, 2.0 * np.pi, 15)
    p, a = np.meshgrid(polar, around, indexing="ij")
    ball = goal + GOAL_RADIUS * np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], axis=-1)
    return [
        (np.array([ball[i, j], ball[i + 1, j], ball[i + 1, j + 1], ball[i, j + 1]]), FOREGROUND["goal"])
        for i in range(len(polar) - 1)
        for j in range(len(around) - 1)
    ]


def _draw_faces(draw: ImageDraw.ImageDraw, view: View, faces: list[tuple[np.ndarray, tuple[int, int, int]]]) -> None:
    """Faces from far to near, shaded by how they lie to the light."""
    placed = [view.place(corners) for corners, _ in faces]
    for index in np.argsort([seen[:, 2].mean() for seen in placed]):
        corners, colour = faces[index]
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        size = np.linalg.norm(normal)
        if size == 0.0:
            continue
        normal = normal / size * np.sign(normal @ view.axes[2] or 1.0)
        shade = 0.62 + 0.38 * max(0.0, float(normal @ LIGHT))
        fill = tuple(int(shade * c) for c in colour)
        draw.polygon([tuple(p) for p in placed[index][:, :2]], fill=fill, outline=fill)


def _draw_floor(draw: ImageDraw.ImageDraw, view: View, low: np.ndarray, high: np.ndarray, floor: float) -> None:
    corners = np.array(
        [[x, y, floor] for x, y in ((low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1]))]
    )
    draw.polygon([tuple(p) for p in view.place(corners)[:, :2]], fill=PLATE)
    for axis in (0, 1):
        for at in np.arange(np.ceil(low[axis] / 0.05) * 0.05, high[axis], 0.05):
            ends = np.array([[low[0], low[1], floor], [high[0], high[1], floor]])
            ends[:, axis] = at
            draw.line([tuple(p) for p in view.place(ends)[:, :2]], fill=GRID, width=FINER)


def _draw_shadow(draw: ImageDraw.ImageDraw, view: View, line: np.ndarray, width: np.ndarray, floor: float) -> None:
    outline = silhouette(line[:, :2], width)
    flat = np.concatenate([outline, np.full((len(outline), 1), floor)], axis=1)
    draw.polygon([tuple(p) for p in view.place(flat)[:, :2]], fill=(0, 0, 0, 28))


def _draw_cables(draw: ImageDraw.ImageDraw, view: View, episodes: Episodes, line: np.ndarray, turn: np.ndarray) -> None:
    """Cables along the body, on the side of their guides; pulled cables are drawn thicker."""
    robot = episodes.robot
    length = float(robot.body.station_m[-1])
    at = np.linspace(0.0, length, len(line))
    tangent = np.gradient(line, axis=0)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
    for guides in robot.guides():
        reach = float(guides[:, 2].max())
        radius = np.interp(at, guides[:, 2], np.linalg.norm(guides[:, :2], axis=1))
        side = np.append(guides[0, :2] / np.linalg.norm(guides[0, :2]), 0.0) @ turn.T
        across = side - (tangent @ side)[:, None] * tangent
        across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
        if (across @ view.axes[2]).mean() < -0.1:  # behind the body
            continue
        path = line + 1.15 * radius[:, None] * across
        seen = view.place(path[at <= reach + 1e-9])[:, :2]
        kind = "long cable" if reach > 0.6 * length else "short cable"
        draw.line([tuple(p) for p in seen], fill=FOREGROUND[kind], width=FINER)


def _draw_goal_line(draw: ImageDraw.ImageDraw, view: View, goal: np.ndarray, floor: float) -> None:
    foot = np.array([goal[0], goal[1], floor])
    ends = view.place(np.stack([goal, foot]))[:, :2]
    draw.line([tuple(p) for p in ends], fill=(*FOREGROUND["goal"], 110), width=FINER)
    x, y = ends[1]
    size = 4 * FINER
    draw.line([(x - size, y), (x + size, y)], fill=FOREGROUND["goal"], width=FINER)


def _caption(draw: ImageDraw.ImageDraw, episodes: Episodes, lane: int) -> None:
    distance = 1e3 * float(episodes.distance()[lane])
    time = episodes.age[lane] * episodes.settings.period
    what = "cube" if episodes.task.push else "tip"
    font = ImageFont.load_default(size=14 * FINER)
    text = f"{episodes.task.name}    t = {time:.2f} s    {what} to goal: {distance:.1f} mm"
    draw.text((12 * FINER, 10 * FINER), text, fill=INK, font=font)
