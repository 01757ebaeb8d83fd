"""Photos in, one by one; a solved block out, whenever it is asked for.

A photo costs its features and its matches once, when it comes. A solution starts from the poses
of the one before it, so asking again after a few more photos does not start over.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from calib.align.adjust import Priors, State
from calib.align.candidates import candidate_pairs
from calib.align.features import WORKING_SIDE_PX, Features, extract, photo_gray, reduced
from calib.align.georeference import GIMBAL_SIGMA_DEG, Placement, Tags, place, read_tags
from calib.align.grow import Partial, build_block, resume_block
from calib.align.matching import PairMatches, match_pair
from calib.align.refine import refine
from calib.align.selfcal import (
    NOMINAL_F_SIGMA,
    UNKNOWN_F_SIGMA,
    Calibrated,
    calibrate,
    with_lens_priors,
)
from calib.align.tracks import build_tracks, select, thin
from calib.camera import BrownCamera
from calib.errors import AlignmentError, PhotoError
from calib.field import Lens
from calib.photos.blur import blurred, sharpness
from calib.photos.photo import LeftOut, Photo
from calib.solution import Observations, Solution

PhotoKey = tuple[Path, str]
#: stage, done, total
Progress = Callable[[str, int, int], None]
#: Tie points kept: at most this many in each cell of a grid over every photo.
CELLS, PER_CELL = 12, 6
#: Sharpness is judged at this size, where slight softness does not matter.
SHARPNESS_SIDE_PX = 1000
#: A priori noise of features on the reduced image, in its pixels.
FEATURE_SIGMA = 0.5


def _silent(stage: str, done: int, total: int) -> None:
    del stage, done, total


@dataclass(frozen=True)
class Settings:
    """``refine``: measure tie points again on the full-size images. ``workers``: photos read at once."""

    seed: int = 0
    refine: bool = True
    workers: int = 2
    memory_bytes: int = 1_000_000_000


@dataclass(frozen=True)
class Aligned:
    """A solution, and the adjustment it came from for those who want to ask it more."""

    solution: Solution
    calibrated: Calibrated


@dataclass
class Memory:
    """What photos and pairs of photos cost once, for further aligners of the same photos.

    Photos are told apart by :func:`photo_key`. Unreadable ones are not kept: a card may come back.
    """

    photos: dict[PhotoKey, tuple[Features, float]] = field(default_factory=dict)
    pairs: dict[tuple[PhotoKey, PhotoKey], PairMatches | None] = field(default_factory=dict)


def photo_key(photo: Photo) -> PhotoKey:
    """Names a file and its content: a file that was replaced is another photo."""
    return photo.path, photo.fingerprint


class Aligner:
    """Collects photos of one camera and solves their block.

    The solution does not depend on what is in ``memory`` already, only its cost does.
    """

    def __init__(
        self,
        settings: Settings | None = None,
        progress: Progress = _silent,
        memory: Memory | None = None,
    ) -> None:
        self.settings = settings or Settings()
        self._progress = progress
        self._memory = memory or Memory()
        self._photos: list[Photo] = []
        self._features: list[Features] = []
        self._sharpness: list[float] = []
        self._pairs: dict[tuple[int, int], PairMatches | None] = {}
        self._unreadable: list[LeftOut] = []
        self._block: Partial | None = None

    def add(self, photo: Photo) -> None:
        """Read one photo; it is matched when a solution is asked for."""
        self.add_all([photo])

    def add_all(self, photos: Sequence[Photo]) -> None:
        """Read photos, ``settings.workers`` at a time; unreadable ones are left out and named."""

        known = self._memory.photos

        def read(photo: Photo) -> tuple[Features, float] | None:
            if photo_key(photo) in known:
                return known[photo_key(photo)]
            try:
                gray, factor = photo_gray(photo, WORKING_SIDE_PX)
            except PhotoError:
                return None
            return extract(gray, factor), sharpness(reduced(gray, SHARPNESS_SIDE_PX))

        with ThreadPoolExecutor(self.settings.workers) as pool:
            for done, (photo, outcome) in enumerate(zip(photos, pool.map(read, photos), strict=True)):
                self._progress("reading photos", done + 1, len(photos))
                if outcome is None:
                    self._unreadable.append(LeftOut(photo.path, "the image data cannot be decoded"))
                    continue
                known[photo_key(photo)] = outcome
                self._photos.append(photo)
                self._features.append(outcome[0])
                self._sharpness.append(outcome[1])

    def solve(self) -> Aligned:
        """The block of all photos so far.

        Raises:
            AlignmentError: fewer than three photos can be joined.
        """
        if len(self._photos) < 3:
            raise AlignmentError(
                f"Only {len(self._photos)} readable photos: a calibration needs at least three that overlap."
            )
        blurry = blurred(self._sharpness)
        self._match(~blurry)
        pairs = [m for (a, b), m in self._pairs.items() if m is not None and not (blurry[a] or blurry[b])]
        camera = self._photos[0].camera
        side = max(camera.width, camera.height)
        obs = build_tracks(self._features, pairs, FEATURE_SIGMA * side / WORKING_SIDE_PX)
        if not len(obs):
            raise AlignmentError(
                "No two photos show the same ground recognisably; check that they overlap and are sharp."
            )
        block = self._grow(obs, pairs)
        return self._finish(obs, block, pairs, blurry)

    # -- steps ---------------------------------------------------------------------------------

    def _match(self, usable: np.ndarray) -> None:
        wanted = [p for p in candidate_pairs(self._photos, self._features, usable) if p not in self._pairs]
        side = max(self._photos[0].camera.width, self._photos[0].camera.height)

        known = self._memory.pairs

        def key(pair: tuple[int, int]) -> tuple[PhotoKey, PhotoKey]:
            return photo_key(self._photos[pair[0]]), photo_key(self._photos[pair[1]])

        def match(pair: tuple[int, int]) -> PairMatches | None:
            a, b = pair
            if key(pair) in known:
                return known[key(pair)]
            return match_pair(a, b, self._features[a], self._features[b], side, self.settings.seed)

        with ThreadPoolExecutor(self.settings.workers) as pool:
            for done, (pair, found) in enumerate(zip(wanted, pool.map(match, wanted), strict=True)):
                self._progress("matching", done + 1, len(wanted))
                known[key(pair)] = found
                self._pairs[pair] = None if found is None else replace(found, a=pair[0], b=pair[1])

    def _tick(self, stage: str) -> Callable[[], None]:
        count = 0

        def tick() -> None:
            nonlocal count
            count += 1
            self._progress(stage, count, 0)

        return tick

    def nominal_focal_px(self) -> float:
        """Median nominal focal length of the photos; an ordinary wide lens where none is known."""
        known = [p.focal_px for p in self._photos if p.focal_px]
        camera = self._photos[0].camera
        return float(np.median(known)) if known else 0.8 * max(camera.width, camera.height)

    def _grow(self, obs: Observations, pairs: Sequence[PairMatches]) -> Partial:
        camera = self._photos[0].camera
        n = len(self._photos)
        tick = self._tick("joining photos")
        block = None
        if self._block is not None:
            block = resume_block(obs, self._block, n, self.settings.seed, tick)
        if block is None:
            lens = Lens(BrownCamera.ideal(camera.width, camera.height, self.nominal_focal_px()))
            block = build_block(obs, pairs, lens, n, self.settings.seed, tick)
        if block is None or block.registered.sum() < 3:
            raise AlignmentError(
                "The photos could not be joined to a block: fewer than three of them overlap with enough "
                "texture. Check that they show one place, textured ground, with 60 % overlap or more."
            )
        self._block = block
        return block

    def _finish(
        self, obs: Observations, block: Partial, pairs: Sequence[PairMatches], blurry: np.ndarray
    ) -> Aligned:
        index = np.flatnonzero(block.registered)
        photos = [self._photos[i] for i in index]
        position = np.full(len(self._photos), -1)
        position[index] = np.arange(len(index))
        sub, old = select(obs, block.active & block.registered[obs.photo])
        kept = thin(sub, len(self._photos), CELLS, PER_CELL)
        sub, again = select(sub, kept[sub.point])
        points = block.points[old[again]]
        local = replace(sub, photo=position[sub.photo])
        tags = read_tags(photos)
        placement = place(block.rotations[index], block.centres[index], points, tags)
        move = placement.transform
        state = State(
            block.lens,
            block.rotations[index] @ move.rotation.T,
            move.apply(block.centres[index]),
            move.apply(points),
        )
        if self.settings.refine:
            local, state = self._refined(photos, local, state)
        priors = self._priors(tags, placement, state)
        standing = np.array([photo.standing for photo in photos])
        calibrated = calibrate(local, state, priors, self._tick("self-calibration"), standing=standing)
        return Aligned(self._solution(calibrated, photos, index, placement, pairs, blurry), calibrated)

    def _refined(
        self, photos: Sequence[Photo], obs: Observations, state: State
    ) -> tuple[Observations, State]:
        total = len(photos)
        refined = refine(
            photos,
            state.lens,
            state.rotations,
            state.centres_m,
            state.points_m,
            obs,
            self.settings.memory_bytes,
            lambda done: self._progress("measuring tie points", done + 1, total),
        )
        ok = refined.ok
        # A photo whose patches mostly fail (blur, moving water) keeps its coarse measurements.
        share = np.bincount(obs.photo, ok) / np.maximum(np.bincount(obs.photo), 1)
        poor = (np.bincount(obs.photo, ok) < 20) | (share < 0.1)
        ok = ok | poor[obs.photo]
        sub, old = select(refined.observations, ok)
        if np.bincount(sub.photo, minlength=total).min() < 6:
            return obs, state
        return sub, replace(state, points_m=state.points_m[old])

    def _priors(self, tags: Tags, placement: Placement, state: State) -> Priors:
        k = len(state.centres_m)
        camera = self._photos[0].camera
        positions, sigma = tags.positions_m.copy(), tags.sigma_m.copy()
        rotations, rotation_sigma = tags.rotations, np.full(k, np.inf)
        if placement.georeference.trusted:
            missing = ~np.isfinite(positions).all(axis=1)
            positions[missing], sigma[missing] = state.centres_m[missing], np.inf
            rotation_sigma[tags.has_rotation] = np.radians(GIMBAL_SIGMA_DEG)
        else:
            # Nothing is known of place and scale; the gauge is held where the block stands.
            extent = float(np.linalg.norm(state.centres_m - state.centres_m.mean(axis=0), axis=1).max())
            positions, sigma = state.centres_m, np.full((k, 3), 30 * max(extent, 1e-6))
        priors = Priors(positions, sigma, rotations, rotation_sigma, np.zeros(0), np.zeros(0))
        share = NOMINAL_F_SIGMA if any(p.focal_px for p in self._photos) else UNKNOWN_F_SIGMA
        return with_lens_priors(priors, camera.width, camera.height, self.nominal_focal_px(), share)

    def _solution(
        self,
        calibrated: Calibrated,
        photos: Sequence[Photo],
        index: np.ndarray,
        placement: Placement,
        pairs: Sequence[PairMatches],
        blurry: np.ndarray,
    ) -> Solution:
        left = list(self._unreadable)
        aligned = set(index.tolist())
        for i, photo in enumerate(self._photos):
            if blurry[i]:
                left.append(LeftOut(photo.path, "blurred"))
            elif i not in aligned:
                left.append(
                    LeftOut(photo.path, "could not be joined to the block (too little overlap or texture)")
                )
        return calibrated.solution(
            photos,
            placement.georeference,
            _components(len(self._photos), pairs, index),
            len(self._photos) + len(self._unreadable),
            left,
        )


def _components(n: int, pairs: Sequence[PairMatches], aligned: np.ndarray) -> tuple[int, ...]:
    """Sizes of the groups of photos that hang together, the aligned one first."""
    a = np.array([p.a for p in pairs], int)
    b = np.array([p.b for p in pairs], int)
    graph = coo_matrix((np.ones(len(a)), (a, b)), shape=(n, n))
    _, label = connected_components(graph, directed=False)
    rest = np.setdiff1d(np.arange(n), aligned)
    others = np.bincount(label[rest]) if len(rest) else np.zeros(0, int)
    return (len(aligned), *sorted((int(s) for s in others if s > 1), reverse=True))
