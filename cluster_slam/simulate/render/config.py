"""How a simulated plant looks, and how the camera errs: options of rendered sessions."""

from __future__ import annotations

from dataclasses import dataclass, fields
from math import inf

from cluster_slam.errors import ConfigError


@dataclass(frozen=True, slots=True)
class LookConfig:
    """Options of the pictures; lengths are for ``scale`` 1."""

    # the plant
    flower_radius_min_m: float = 0.0085  # tip of the petals from the centre
    flower_radius_max_m: float = 0.0115
    flower_tilt: float = 0.7  # spread of the flowers' directions about "towards the arm and a little up"
    foliage_per_m: float = 20.0  # compound leaves a metre of stem
    n_distractors: int = 30  # buds, berries and pale leaves that are no flowers
    petal_pink: float = 0.25  # 0 white petals, 1 as pink as brambles get

    # light
    sun: float = 1.0  # strength of the direct light; 0: overcast
    sky: float = 0.45  # strength of the light from everywhere
    exposure: float = 1.0  # times the right one
    vary_light: float = 0.1  # clouds: sigma of the light over seconds, relative

    # the colour camera
    exposure_s: float = 0.004  # of a picture: what moves meanwhile is blurred
    blur_px: float = 0.6  # sigma of the lens
    noise: float = 1.0  # of the sensor, times that of a small industrial one
    jpeg_quality: int = 94

    # the depth camera
    depth_camera: str = "generic"  # generic (sigma as depth_sigma says), d405 or d435
    holes: float = 1.0  # share of pixels without depth beside those of occlusion, times the usual

    def __post_init__(self) -> None:
        for name in (f.name for f in fields(self)):
            value = getattr(self, name)
            if not isinstance(value, str) and not 0 <= value < inf:
                raise ConfigError(f"look.{name} must be a number from 0, not {value}")
        if not 0 < self.flower_radius_min_m <= self.flower_radius_max_m:
            raise ConfigError("look.flower_radius_min_m must lie within 0 and look.flower_radius_max_m")
        if not 1 <= self.jpeg_quality <= 100:
            raise ConfigError(f"look.jpeg_quality must lie within 1 and 100, not {self.jpeg_quality}")
        if self.depth_camera not in DEPTH_CAMERAS:
            raise ConfigError(f"look.depth_camera must be one of {DEPTH_CAMERAS}, not {self.depth_camera!r}")


DEPTH_CAMERAS = ("generic", "d405", "d435")
