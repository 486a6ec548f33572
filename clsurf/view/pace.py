"""How fine the next picture is: coarse enough to keep up while something moves, finer step by step once it is still."""

from dataclasses import dataclass, replace

# What is drawn while something moves: every so many-th pixel each way, and the level of detail in pixels.
STEPS = ((1, 4.0), (1, 8.0), (2, 8.0), (3, 8.0), (4, 12.0), (6, 16.0), (8, 24.0))
BUDGET = 0.033  # seconds of drawing a moving picture, of the 0.066 between two at 15 a second: the rest is the canvas's
SETTLE = 0.12  # seconds without a movement after which the picture is refined
LONGEST = 1.5  # seconds: a refinement expected to take longer is left out


@dataclass(frozen=True)
class Quality:
    """How one picture is drawn."""

    reduce: int = 1  # pixels of the canvas to a pixel of the picture, each way
    lod: float = 4.0  # pixels
    supersampling: int = 1
    lines: bool = False


FULL = Quality()
FINE = Quality(supersampling=2, lines=True)


@dataclass(frozen=True)
class Pace:
    """What has been learnt of the machine's speed, and how far the picture on show is refined."""

    step: int = 0  # of STEPS
    shown: int = 0  # 0: as it moved, 1: full, 2: fine
    moved: float = float("-inf")  # time of the last movement, seconds
    full_seconds: float = 0.0  # that the last full picture took

    def quality(self, now: float) -> Quality:
        """Return how to draw the picture that is asked for at `now`."""
        if not self._settled(now):
            reduce, lod = STEPS[self.step]
            return Quality(reduce, lod)
        return FINE if self.shown >= 1 and self._fine_is_fast else FULL

    def _settled(self, now: float) -> bool:
        return now - self.moved >= SETTLE - 1e-6

    @property
    def _fine_is_fast(self) -> bool:
        return 4 * self.full_seconds < LONGEST

    def touched(self, now: float) -> "Pace":
        """Return the pace after something moved."""
        return replace(self, moved=now, shown=0)

    def stale(self) -> "Pace":
        """Return the pace after something changed that does not move: the full picture comes at once."""
        return replace(self, moved=float("-inf"), shown=0)

    def drawn(self, quality: Quality, seconds: float, now: float) -> "Pace":
        """Return the pace after a picture has been drawn in `seconds`."""
        if quality == FINE:
            return replace(self, shown=2)
        if quality == FULL and self._settled(now):
            return replace(self, shown=1, full_seconds=seconds)
        step = self.step
        if seconds > BUDGET:
            step = min(step + 1, len(STEPS) - 1)
            if seconds > 3 * BUDGET:
                step = min(step + 1, len(STEPS) - 1)
        elif step > 0:
            # A finer step is expected to take longer by its pixels, or by a third where only the detail is finer.
            ratio = (STEPS[step][0] / STEPS[step - 1][0]) ** 2
            step -= seconds * max(ratio, 1.33) < 0.7 * BUDGET
        return replace(self, step=step)

    def due(self, now: float) -> float | None:
        """Return in how many seconds the next refinement is to be drawn; None: the picture is as fine as it gets."""
        if self.shown == 2 or (self.shown == 1 and not self._fine_is_fast):
            return None
        return max(0.0, self.moved + SETTLE - now) if self.shown == 0 else 0.0
