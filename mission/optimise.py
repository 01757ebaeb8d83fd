"""The cheapest photos that make a network calibrate: greedy choice, then exchange.

Serves the plan before take-off and the pass after a flight alike: what differs is the network that
the photos are added to, and the path that they are flown from. The criterion is robust: it holds
with any one of the added photos missing. Deterministic.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import combinations, starmap

import numpy as np

from calib.camera import FloatArray
from calib.limits import FOCAL_SIGMA_ALONE_PERCENT
from calib.network_extension import Joint, PhotoPool
from mission.route import Detours

#: Half of [C&D]'s 0.1 % of the flying height.
DOME_SIGMA_PERCENT = 0.05
#: More photos than this are not an extra pass any more.
MOST_ADDED = 40
#: Candidates looked at in every round after the first.
SHORT_LIST = 80
#: Pools of fewer photos than this are searched from more than one start.
SMALL_POOL = 200
#: Of the exchanges that save time, how many are looked at, and of those how many tried in full.
_LOOKED_AT, _TRIED = 40, 3
#: Joint covariances remembered, of some megabytes each.
_JOINTS_KEPT = 4


@dataclass(frozen=True)
class Criterion:
    """What has to be reached, model error included, with any one added photo missing.

    ``least_photos``: at least so many are added, however good they are.
    """

    sigma_f_percent: float = FOCAL_SIGMA_ALONE_PERCENT
    dome_percent: float = DOME_SIGMA_PERCENT
    least_photos: int = 0

    def ratio(self, worth: tuple[float, float]) -> float:
        """(sigma f, dome sigma) in percent against the limits; at most 1 where both hold."""
        return max(worth[0] / self.sigma_f_percent, worth[1] / self.dome_percent)


@dataclass(frozen=True)
class Choice:
    """Photos of the pool, what they cost, and the criterion's ratio with the worst one missing."""

    photos: tuple[int, ...]
    seconds: float
    ratio: float

    @property
    def good(self) -> bool:
        """Whether the criterion is met."""
        return self.ratio <= 1.0


class Worths:
    """(sigma f, dome sigma) in percent with photos of a pool, remembered: they serve any criterion.

    Args:
        worth: covariance of lens and functionals -> (sigma f, dome sigma) in percent.
    """

    def __init__(self, pool: PhotoPool, worth: Callable[[FloatArray], tuple[float, float]]) -> None:
        self.pool, self.worth = pool, worth
        self._known: dict[tuple[int, ...], tuple[float, float]] = {}
        self._joints: dict[tuple[int, ...], Joint] = {}

    def alone(self, photos: Sequence[int]) -> tuple[float, float]:
        """With these photos, none missing."""
        key = tuple(sorted(photos))
        if key not in self._known:
            self._known[key] = self.worth(self.joint(photos).head)
        return self._known[key]

    def without(self, photos: Sequence[int], one: int, single: bool = False) -> tuple[float, float]:
        """With these photos (sorted) but ``one`` of them; ``single``: the others will hardly be asked for."""
        rest = tuple(p for p in photos if p != one)
        if rest not in self._known:
            if not rest:
                head = self.pool.joint.head
            elif single and tuple(photos) not in self._joints:
                head = self.pool.head(rest)
            else:
                head = self.joint(photos).head_without(self.pool.rows[one])
            self._known[rest] = self.worth(head)
        return self._known[rest]

    def worst(self, photos: tuple[int, ...]) -> tuple[float, float]:
        """The larger of either with any one of the photos (sorted) missing."""
        each = [self.without(photos, one) for one in photos] or [self.alone(())]
        return max(e[0] for e in each), max(e[1] for e in each)

    def one_more(
        self, photos: tuple[int, ...], i: int, joint: Callable[[], Joint] | None = None
    ) -> tuple[float, float]:
        """With ``photos`` and photo ``i``, none missing. ``joint``: how to come by that of ``photos``."""
        key = tuple(sorted((*photos, i)))
        if key not in self._known:
            now = self.joint(photos) if joint is None else joint()
            self._known[key] = self.worth(now.head_with(self.pool.rows[i]))
        return self._known[key]

    def joint(self, photos: Sequence[int]) -> Joint:
        """Of the network with ``photos``; the last few are kept."""
        key = tuple(sorted(photos))
        if not key:
            return self.pool.joint
        if key not in self._joints:
            before = tuple(sorted(photos[:-1]))
            if before in self._joints or not before:
                made = self.joint(before).with_photo(self.pool.rows[photos[-1]])
            else:
                made = self.pool.combined(key)
            while len(self._joints) >= _JOINTS_KEPT:
                del self._joints[next(iter(self._joints))]
            self._joints[key] = made
        return self._joints[key]


def _never(one: int, other: int) -> bool:
    del one, other
    return False


class Search:
    """Chooses photos of a pool.

    Args:
        alike: two photos of the pool of which a choice takes only one; None: there are none.
    """

    def __init__(
        self,
        worths: Worths,
        detours: Detours,
        criterion: Criterion,
        alike: Callable[[int, int], bool] | None = None,
    ) -> None:
        self.alike = alike or _never
        self._pain: dict[int, float] = {}
        self.worths, self.pool, self.detours, self.criterion = worths, worths.pool, detours, criterion

    def ratio(self, photos: Sequence[int]) -> float:
        """The criterion's ratio with the worst photo missing; infinite with too few of them."""
        key = tuple(sorted(photos))
        return self.criterion.ratio(self.worths.worst(key)) if self._eligible(key) else math.inf

    def none_missing(self, photos: Sequence[int]) -> float:
        """The criterion's ratio with all of the photos: at most :meth:`ratio`, and found sooner."""
        return self.criterion.ratio(self.worths.alone(photos))

    def holds(self, photos: Sequence[int]) -> bool:
        """Whether :meth:`ratio` is at most 1; no, as soon as one photo's absence shows it."""
        key = tuple(sorted(photos))
        return self._eligible(key) and self._robust(key)

    def _eligible(self, key: tuple[int, ...]) -> bool:
        return len(key) >= self.criterion.least_photos and not any(starmap(self.alike, combinations(key, 2)))

    def _robust(self, key: tuple[int, ...]) -> bool:
        if len(key) < 2:
            return self.criterion.ratio(self.worths.worst(key)) <= 1.0
        # First those that were missed most lately: mostly it is one of them.
        in_order = sorted(key, key=lambda i: (-self._pain.get(i, 0.0), i))
        for place, one in enumerate(in_order):
            self._pain[one] = self.criterion.ratio(self.worths.without(key, one, place < 1))
            if self._pain[one] > 1.0:
                return False
        return True

    def choice(self, photos: Sequence[int]) -> Choice:
        """A set of photos as a :class:`Choice`."""
        key = tuple(sorted(photos))
        return Choice(key, self.detours.seconds(key), self.ratio(key))

    def greedy(
        self,
        start: Sequence[int] = (),
        by_time: bool = True,
        most_s: float = math.inf,
        among: Collection[int] | None = None,
    ) -> Choice:
        """Add the photo that helps most (per second in the air) until the criterion is met.

        Given up where that takes more than ``most_s`` or ``MOST_ADDED`` photos. ``among``: photos that may be
        added; None: any of the pool.
        """
        chosen = list(start)
        now = self.none_missing(chosen)
        may = range(len(self.pool)) if among is None else sorted(among)
        left = [i for i in may if i not in chosen and not self._taken(i, chosen)]
        while left and len(chosen) < MOST_ADDED and self.detours.seconds(chosen) <= most_s:
            # With a photo missing it is worse still.
            if now <= 1.0 and self.holds(chosen):
                break
            cost = self.detours.insertion_s(chosen)
            after = {i: self._with_one(tuple(chosen), i) for i in left}
            gain = {i: math.log(now / after[i]) / (cost[i] if by_time else 1.0) for i in left}
            # What helps little now helps little later: information of more photos only overlaps.
            left = sorted(left, key=lambda i: (-gain[i], i))[:SHORT_LIST]
            chosen.append(left.pop(0))
            left = [i for i in left if not self.alike(i, chosen[-1])]
            now = after[chosen[-1]]
        return self.choice(chosen)

    def _taken(self, i: int, chosen: Sequence[int]) -> bool:
        return any(self.alike(i, one) for one in chosen)

    def _with_one(self, photos: tuple[int, ...], i: int, joint: Callable[[], Joint] | None = None) -> float:
        """The ratio with one photo more, none missing."""
        return self.criterion.ratio(self.worths.one_more(photos, i, joint))

    def exchange(self, choice: Choice) -> Choice:
        """Leave photos out and swap them for others as long as that saves time and stays good."""
        if not choice.good:
            return choice
        while True:
            better = self._without_one(choice) or self._with_another(choice)
            if better is None:
                return choice
            choice = better

    def _without_one(self, choice: Choice) -> Choice | None:
        """The choice without its dearest dispensable photo."""
        n = len(choice.photos)
        if n < 3 or n <= self.criterion.least_photos:
            return None
        rest = [tuple(p for p in choice.photos if p != one) for one in choice.photos]
        costs = [self.detours.seconds(r) for r in rest]
        order = sorted(range(n), key=lambda a: (costs[a], a))
        first = next(self.dispensable(choice.photos, order), None)
        return None if first is None else self.choice(rest[first])

    def dispensable(self, photos: Sequence[int], order: Sequence[int] | None = None) -> Iterator[int]:
        """Places in ``photos`` (sorted; looked at in ``order``) without which the criterion still holds."""
        key, limits = tuple(photos), self.criterion.ratio
        # Hardly ever can the two go that are missed most.
        most = max(key, key=lambda i: (limits(self.worths.without(key, i)), i))
        without_most = tuple(p for p in key if p != most)
        for a in range(len(key)) if order is None else order:
            rest = tuple(p for p in key if p != key[a])
            if (
                limits(self.worths.without(key, key[a])) <= 1.0
                and (key[a] == most or limits(self.worths.without(without_most, key[a])) <= 1.0)
                and self._robust(rest)
            ):
                yield a

    def _with_another(self, choice: Choice) -> Choice | None:
        for one in choice.photos:
            rest = tuple(p for p in choice.photos if p != one)
            cost = self.detours.seconds(rest) + self.detours.insertion_s(rest)
            order = np.argsort(cost, kind="stable")
            cheaper = [int(i) for i in order if cost[i] < choice.seconds - 0.1 and i not in choice.photos]
            if not cheaper:
                continue
            tried = 0
            for i in cheaper[:_LOOKED_AT]:
                if self._taken(i, rest) or self.hopeless(choice.photos, one, i):
                    continue
                swapped = (*rest, i)
                if self.detours.seconds(swapped) < choice.seconds - 0.05 and self.holds(swapped):
                    return self.choice(swapped)
                tried += 1
                if tried == _TRIED:
                    break
        return None

    def hopeless(self, photos: tuple[int, ...], one: int, instead: int) -> bool:
        """Whether ``instead`` in place of ``one`` misses the criterion even with none of them missing."""
        rest = tuple(p for p in photos if p != one)
        return self._with_one(rest, instead, partial(self._joint_without, photos, one)) > 1.0

    @lru_cache(maxsize=2)  # noqa: B019 a search lives as long as its answer takes
    def _joint_without(self, photos: tuple[int, ...], one: int) -> Joint:
        return self.worths.joint(photos).without_photo(self.pool.rows[one])

    def best(self, sets: Sequence[Sequence[int]] = (), parts: Sequence[Collection[int]] = ()) -> Choice:
        """The best choice from several starts: greedy ones, and given sets (orbits, fans).

        Where none meets the criterion, the one that comes nearest to it. ``parts`` of the pool that greedy
        choices are made from, too: a photo that helps most at first may lead away from the best pass.
        """
        found: list[Choice] = []
        in_time = sorted(sets, key=lambda s: (self.detours.seconds(s), tuple(s)))
        # The others take longer.
        shortest = next((one for one in in_time if self.holds(one)), None)
        if shortest is not None:
            found.append(self.choice(shortest))
        # Small pools are searched from many first photos.
        firsts = sorted(range(len(self.pool)), key=lambda i: (self._with_one((), i), i))
        few = firsts[: min(SMALL_POOL // len(firsts), 10)]
        starts = [((), None), *(((i,), None) for i in few), *(((), part) for part in parts)]
        for start, among in starts:
            for by_time in (True, False):
                cheapest = min((c.seconds for c in found if c.good), default=math.inf)
                found.append(self.greedy(start, by_time, 1.5 * cheapest, among))
        good = sorted((c for c in found if c.good), key=lambda c: (c.seconds, c.photos))
        if not good:
            found += [self.choice(one) for one in in_time]
            return min(found, key=lambda c: (c.ratio, c.seconds, c.photos))
        fewest = min(good, key=lambda c: (len(c.photos), c.seconds, c.photos))
        improved = [self.exchange(c) for c in dict.fromkeys([*good[: 1 + len(starts)], fewest])]
        # Time counts, but a photo is also one more thing to go wrong.
        least = min(len(c.photos) for c in improved)
        return min((c for c in improved if len(c.photos) <= least + 1), key=lambda c: (c.seconds, c.photos))
