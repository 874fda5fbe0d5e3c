"""A board that nobody measured: places of square tags of one known side, by bundle adjustment of photographs of them.

Where a tag stands beside another is first found from the views that show both: a square has two poses that fit its picture
almost alike (IPPE, Collins and Bartoli 2014), and of the pairs of them one alone is the same in every view.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from scipy.optimize import least_squares

from schemas.base import Array, Pose
from schemas.errors import CaptureError, command_line
from schemas.job.captures import Board
from workers.capture.board import LARGEST, id_words, open_dictionary, opencv_poses, smallest_dictionary
from workers.capture.board_kinds import UPRIGHT, board_of_markers, recognise_board
from workers.capture.detect import find_markers, other_dictionary, unbend_corners
from workers.capture.folder import CaptureFolder, read_view
from workers.capture.poses.corners import outward_motion
from workers.capture.poses.terms import GROW_PX, cross_matrix, moved
from workers.geometry.camera import spread_evenly
from workers.geometry.frames import invert, transform
from workers.geometry.pixels import rays_of_pixels

SQUARE = UPRIGHT - [0.5, 0.5, 0.0]
"""Corners of a tag of side 1, clockwise from the upper left, as OpenCV's IPPE_SQUARE has them."""
ROBUST_PX = 0.3
"""Residuals beyond this count by their size alone: three times what a refined corner is off."""
FLAT_M = 0.005
"""Tags whose corners are so near to a plane lie in it: sheets are not flat."""
AMBIGUOUS_M = 0.01
"""Worse agreement of two views on where a tag stands is none."""

LOOKED_AT = 8
"""Views by which a board that is not board.json's is recognised."""
Seen = Mapping[int, Mapping[int, Array]]
"""By view and tag: rays [4, 2] of its corners."""


@dataclass(frozen=True)
class SolvedBoard:
    """The board, how many of its tags lie in its plane, and how many views were used.

    residual_px: of a corner. sigma_m, worst_m: standard deviation of a corner's place beside the first tag, usual and worst.
    `left_out`: tags that nothing joins to the others.
    """

    board: Board
    flat: int
    views: int
    residual_px: float
    sigma_m: float
    worst_m: float
    left_out: tuple[int, ...]


def solve_board(folder: CaptureFolder, side_m: float, dictionary: str) -> SolvedBoard:
    """The places of all tags of a dictionary in a folder's photographs. Raises CaptureError where they do not hang together."""
    seen = _see(folder, open_dictionary(Board(dictionary=dictionary), folder.path), 1)
    square = side_m * SQUARE
    tags, views = _join(seen, square)
    if len(tags) < 2 or len(views) < 3:
        raise CaptureError(
            "board",
            f"{folder.path}: {len(views)} photographs show several tags of {dictionary} together: a board needs 3, and tags that "
            "overlap from one to the next; photograph it from more sides, or name the --dictionary of its tags",
        )
    focal = 0.5 * (folder.camera.intrinsics.fx + folder.camera.intrinsics.fy)
    tags, residual_px, sigma = _adjust(seen, tags, views, square, focal)
    ids = sorted(tags)
    corners = _in_plane(np.array([transform(tags[n], square) for n in ids]), ids.index(next(iter(tags))), views)
    flat = int((np.abs(corners[..., 2]).max(axis=1) < FLAT_M).sum())
    lost = tuple(sorted({n for tags_seen in seen.values() for n in tags_seen} - set(ids)))
    board = board_of_markers(dictionary, ids, corners)
    return SolvedBoard(board, flat, len(views), residual_px, float(np.median(sigma)), float(sigma.max()), lost)


def other_board(folder: CaptureFolder) -> str:
    """What the photographs show in place of board.json's board, with the command that describes it; or nothing."""
    board = folder.board
    words, name, border_bits = other_dictionary(read_view(folder, folder.numbers[len(folder.numbers) // 2]).rgb)
    if not name:
        return words
    seen = _see(folder, open_dictionary(Board(dictionary=name)), border_bits, LOOKED_AT)
    recognised = recognise_board(list(seen.values()), board, name)
    if recognised is None:
        return "" if name == smallest_dictionary(board.dictionary, LARGEST) else f"{words}: correct board.json"
    kind, sizes = recognised
    words = f"{kind.replace('charuco', 'ChArUco')}, {sizes.columns} x {sizes.rows} of {sizes.dictionary}"
    options = ["--kind", kind, "--size", f"{sizes.columns}x{sizes.rows}", "--dictionary", sizes.dictionary]
    options += ["--marker", f"{sizes.marker_m:g}", "--pitch", f"{sizes.pitch_m:g}"]
    command = command_line("capture", "board", folder.path / "board.json", *options)
    remedy = f"move it away, and `{command}` writes the right one; measure both lengths on the print"
    return f"the photographs show another board than board.json has, {words}: {remedy}"


def describe(solved: SolvedBoard) -> list[str]:
    """What is known of it, in words, line by line."""
    places = f"{solved.sigma_m * 1e3:.3f} mm, the worst to {solved.worst_m * 1e3:.3f} mm, beside the first"
    lines = [
        f"{solved.board.words} in {solved.views} photographs: corners {solved.residual_px:.3f} px off, their places known to "
        f"{places}; all scale with --marker"
    ]
    if solved.flat < len(solved.board.markers):
        under = f"z = 0, what the object stands on, is the plane of {solved.flat} of them"
        lines.append(f"{under}: move the corners if it is another")
    if solved.left_out:
        lines.append(f"left out, no photograph shows them beside the others: {id_words(np.array(solved.left_out))}")
    return lines


def _see(
    folder: CaptureFolder, dictionary: "cv2.aruco.Dictionary", border_bits: int, most_views: int | None = None
) -> Seen:
    """The markers of a dictionary in all views, or in some of them."""
    seen, count = {}, len(folder.numbers)
    for place in spread_evenly(count, most_views or count):
        ids, corners = find_markers(read_view(folder, folder.numbers[place]).rgb, dictionary, border_bits)
        camera = folder.camera
        rays = rays_of_pixels(unbend_corners(corners, camera).reshape(-1, 2), camera.intrinsics, camera.lens)
        quads = rays.reshape(-1, 4, 2)
        whole = np.flatnonzero(np.isfinite(quads).all(axis=(1, 2)))
        seen[folder.numbers[place]] = {int(ids[k]): quads[k] for k in whole}
    return seen


def _join(seen: Seen, square: Array) -> tuple[dict[int, Pose], dict[int, Pose]]:
    """(T_board_tag by tag, that of the first being the board's; T_cam_board by view), by the best joined pairs."""
    single = {
        view: {n: opencv_poses(square, rays, cv2.SOLVEPNP_IPPE_SQUARE) for n, rays in tags.items()}
        for view, tags in seen.items()
    }
    pairs: dict[tuple[int, int], list[list[Pose]]] = {}
    for both in single.values():
        for a, b in combinations(sorted(both), 2):
            pairs.setdefault((a, b), []).append([invert(Ta) @ Tb for Ta in both[a] for Tb in both[b]])
    joined = {pair: _most_alike(options, square) for pair, options in pairs.items()}
    counts = Counter(n for tags in seen.values() for n in tags)
    if not counts:
        return {}, {}
    places = {max(sorted(counts), key=lambda n: counts[n]): np.eye(4)}
    while True:
        edges = [
            (-views, off_m, a, b, T)
            for (a, b), (T, off_m, views) in joined.items()
            if (a in places) != (b in places) and off_m < AMBIGUOUS_M
        ]
        if not edges:
            break
        _, _, a, b, T = min(edges, key=lambda edge: edge[:4])
        if a in places:
            places[b] = places[a] @ T
        else:
            places[a] = places[b] @ invert(T)
    return places, _views_of(seen, places, square)


def _most_alike(views: list[list[Pose]], square: Array) -> tuple[Pose, float, int]:
    """(of the candidates of each view the pose that is most like one of every view; metres apart, median; views)."""
    corners = [np.array([transform(T, square).ravel() for T in some]) for some in views]
    best: tuple[float, Pose] = np.inf, views[0][0]
    for of_view, options in zip(corners, views, strict=True):
        for candidate, T in zip(of_view, options, strict=True):
            gaps = [np.linalg.norm(other - candidate, axis=1).min() / 2.0 for other in corners]
            best = min(best, (float(np.median(gaps)), T), key=lambda pair: pair[0])
    return best[1], best[0], len(views)


def _views_of(seen: Seen, places: Mapping[int, Pose], square: Array) -> dict[int, Pose]:
    poses = {}
    for view, tags in seen.items():
        known = [n for n in tags if n in places]
        if len(known) < 2:
            continue
        points = np.concatenate([transform(places[n], square) for n in known])
        rays = np.concatenate([tags[n] for n in known])
        for T in opencv_poses(points, rays, cv2.SOLVEPNP_SQPNP)[:1]:
            poses[view] = T
    return poses


def _adjust(
    seen: Seen, tags: Mapping[int, Pose], views: Mapping[int, Pose], square: Array, focal: float
) -> tuple[dict[int, Pose], float, Array]:
    """(tags, the first of them held; residual, pixels; [M - 1, 4] sigma of corners, metres) by all corners at once."""
    held, *free = tags
    pairs = [(view, n) for view in views for n in seen[view] if n in tags]
    at_view = np.array([list(views).index(view) for view, _ in pairs])
    at_tag = np.array([list(tags).index(n) for _, n in pairs])
    rays = np.array([seen[view][n] for view, n in pairs])
    outward = outward_motion(rays.reshape(-1, 2), np.ones(rays.size // 2, bool)).reshape(rays.shape)
    begun = np.array([*views.values(), *(tags[n] for n in free)])

    def at(x: Array) -> tuple[Array, Array]:
        T = moved(begun, x[:-1].reshape(-1, 6))
        return T[: len(views)], np.concatenate([tags[held][None], T[len(views) :]])

    def off(x: Array) -> Array:
        T_cam_board, T_board_tag = at(x)
        T = T_cam_board[at_view] @ T_board_tag[at_tag]
        p = np.einsum("kij,cj->kci", T[:, :3, :3], square) + T[:, None, :3, 3]
        px = focal * (p[..., :2] / p[..., 2:] - rays) + 2.0 * x[-1] * outward
        return np.append(px.ravel(), x[-1] * ROBUST_PX / GROW_PX)

    fit = least_squares(off, np.zeros(6 * len(begun) + 1), loss="soft_l1", f_scale=ROBUST_PX, x_scale="jac")
    residual = fit.fun[:-1]
    spread = 1.4826 * float(np.median(np.abs(residual))) * np.sqrt(residual.size / (residual.size - fit.x.size))
    covariance = spread**2 * np.linalg.pinv(fit.jac.T @ fit.jac, hermitian=True)
    places = at(fit.x)[1]
    lever = np.concatenate([np.tile(np.eye(3), (4, 1, 1)), -cross_matrix(square)], axis=2)  # in the tag's frame
    blocks = [covariance[n : n + 6, n : n + 6] for n in range(6 * len(views), 6 * len(begun), 6)]
    sigma = np.sqrt(np.einsum("cij,njk,cik->nc", lever, np.array(blocks), lever))
    return dict(zip(tags, places, strict=True)), spread, sigma


def _in_plane(corners: Array, first: int, views: Mapping[int, Pose]) -> Array:
    """Corners [M, 4, 3] in the board's frame: z = 0 the plane of most tags, z towards the cameras, x as the first tag's."""
    best = np.zeros(len(corners), bool)
    for quad in corners:
        normal = np.cross(quad[1] - quad[0], quad[3] - quad[0])
        near = np.abs((corners - quad.mean(axis=0)) @ (normal / np.linalg.norm(normal))).max(axis=1) < FLAT_M
        best = max(best, near, key=lambda near: int(near.sum()))
    flat = corners[best].reshape(-1, 3)
    middle = 0.5 * (flat.min(axis=0) + flat.max(axis=0))
    z = np.linalg.svd(flat - flat.mean(axis=0))[2][2]
    middle = middle - ((middle - flat.mean(axis=0)) @ z) * z
    cameras = np.array([invert(T)[:3, 3] for T in views.values()])
    z = z * np.sign(np.median((cameras - middle) @ z))
    x = corners[first][1] - corners[first][0]
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    placed: Array = (corners - middle) @ np.array([x, np.cross(z, x), z]).T
    return placed - [*(0.5 * (placed[best].min(axis=(0, 1)) + placed[best].max(axis=(0, 1))))[:2], 0.0]
