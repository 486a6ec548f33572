"""Where the picture is seen from: the camera's options of `render` and `report`."""

from dataclasses import dataclass
from typing import Annotated

import typer

from ..errors import InputError

DirectionOption = Annotated[str, typer.Option(help="From the target to the eye: x,y,z; the model fills the picture "
                                              "[1,0.5,2].")]
UpOption = Annotated[str, typer.Option(help="Upward: x,y,z.")]
FovOption = Annotated[float | None, typer.Option(help="Vertical field of view, degrees [40].")]
EyeOption = Annotated[str, typer.Option(help="Place of the eye: x,y,z, world units; in place of --direction.")]
TargetOption = Annotated[str, typer.Option(help="Point in the picture's middle: x,y,z [the model's middle].")]
OrthoOption = Annotated[float | None, typer.Option(help="Orthographic: height of the picture, world units.")]


@dataclass(frozen=True)
class View:
    """A camera's options, checked; the model completes them."""

    direction: tuple[float, float, float]
    up: tuple[float, float, float]
    fov: float
    eye: tuple[float, float, float] | None
    target: tuple[float, float, float] | None
    ortho: float | None  # world units

    def camera(self, thing, size: tuple[int, int]):
        """Return the camera that sees `thing`, something with bounds, in a picture of `size` pixels."""
        import numpy as np

        from ..render.camera import Camera
        if self.eye is None and self.target is None and self.ortho is None:
            return Camera.framing(thing, self.direction, self.fov, self.up, aspect=size[0] / size[1])
        box = np.asarray(thing.bounds, np.float64)
        if self.target is None and not np.isfinite(box).all():
            raise InputError("camera: expected something with a finite bounding box, got an empty one: give --target")
        target = box.mean(axis=0) if self.target is None else np.array(self.target)
        if self.eye is not None:
            eye = np.array(self.eye)
        else:
            far = float(np.linalg.norm(box[1] - box[0])) if np.isfinite(box).all() else 1.0
            eye = target + np.array(self.direction) / np.linalg.norm(self.direction) * (far or 1.0)
            if self.ortho is None:  # a target of the user's own: the framing distance, looking at it
                framed = Camera.framing(thing, self.direction, self.fov, self.up, aspect=size[0] / size[1])
                eye = target + framed.rotation[2] * float((framed.eye - box.mean(axis=0)) @ framed.rotation[2])
        if self.ortho is not None:
            return Camera.orthographic(eye, target, self.up, self.ortho)
        return Camera.look_at(eye, target, self.up, self.fov)


def checked_view(direction: str, up: str, fov: float | None, eye: str, target: str, ortho: float | None) -> View:
    """Return the options of a camera, or raise InputError."""
    if eye and direction:
        raise InputError("camera: expected --direction or --eye, got both")
    if ortho is not None and fov is not None:
        raise InputError("camera: expected --fov or --ortho, got both")
    if fov is not None and not 0 < fov < 180:
        raise InputError(f"fov: expected degrees between 0 and 180, got {fov:g}")
    if ortho is not None and not 0 < ortho < float("inf"):
        raise InputError(f"ortho: expected a positive height in world units, got {ortho:g}")
    toward, upward = parsed_vector("direction", direction or "1,0.5,2"), parsed_vector("up", up)
    if eye and target and parsed_point("eye", eye) == parsed_point("target", target):
        raise InputError(f"camera: expected --eye and --target apart, got {eye} for both")
    return View(toward, upward, 40.0 if fov is None else fov, parsed_point("eye", eye) if eye else None,
                parsed_point("target", target) if target else None, ortho)


def parsed_point(name: str, text: str) -> tuple[float, float, float]:
    """Return three finite numbers of a text such as 1,0.5,2."""
    try:
        x, y, z = (float(part) for part in text.split(","))
        if not abs(x) + abs(y) + abs(z) < float("inf"):
            raise ValueError
    except ValueError:
        raise InputError(f"{name}: expected three numbers such as 1,0.5,2, got {text!r}") from None
    return x, y, z


def parsed_vector(name: str, text: str) -> tuple[float, float, float]:
    """Return three numbers of a text such as 1,0.5,2, not all zero."""
    try:
        x, y, z = parsed_point(name, text)
        if not 0 < x * x + y * y + z * z < float("inf"):
            raise InputError("")
    except InputError:
        raise InputError(f"{name}: expected three numbers such as 1,0.5,2, not all 0, got {text!r}") from None
    return x, y, z
