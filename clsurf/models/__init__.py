"""Generated scans and surfaces, for tests, demonstrations and where no data file is at hand."""

from .amphora import demo_scan as demo_scan
from .basic import cylinder as cylinder
from .basic import disc as disc
from .basic import ellipsoid as ellipsoid
from .basic import sphere as sphere
from .basic import torus as torus
from .earth import earth as earth
from .meteoroid import meteoroid as meteoroid
from .perfect_sphere import perfect_sphere as perfect_sphere
