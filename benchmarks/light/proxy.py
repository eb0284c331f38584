"""What does a mesh of the place save, where the photo holds shadows already?

    python -m benchmarks.light.proxy --out DIR [--panorama FILE] [--samples 256] [--width 480]
        [--json FILE]

A made-up yard, open ground and one wall, is path-traced by Mitsuba 3 (`benchmarks.referee`, which
shares no code with warpir) without the car, which makes the photo, and with it, which is the truth.
The car is then put into the photo under the same light: with the ground plane alone, with a painted
shadow mask, with the wall as the mesh of `--proxy`, and with wall and ground as that mesh. RMSE is
of display values, over the box of all that the car changes in the truth and over the whole picture.
"""

import time
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measure import flags, report
from benchmarks.scenes import on_the_ground, photo_of, write_picture
from tests.builders.shapes import box
from tools.demo.textures import paving_texture
from warpir.core.arrays import Float64Array, FloatArray, PixelArray, mask_box
from warpir.core.color import linear_to_gamma
from warpir.core.latlong import look_up, resize_map, rotate_map
from warpir.demo import ASSET, LIGHT
from warpir.evaluate.image_errors import rmse
from warpir.io.assets import load_asset
from warpir.io.gltf.reader import place
from warpir.io.images.photos import Photo, read_envmap
from warpir.mitsuba.render import Setting, foreground
from warpir.render.composite import make_picture
from warpir.render.device import choose_device
from warpir.render.device_scene import Placed, Receiver, Scene
from warpir.render.picture.photo_scene import photo_radiance
from warpir.render.picture.quality import Quality
from warpir.render.renderer import Renderer
from warpir.scene.asset import Asset, Material, Primitive, Texture, TextureSlot
from warpir.scene.camera import Camera, camera_from_fov
from warpir.scene.lamps import lamp_axes
from warpir.scene.light import Light, angles_from_axis
from warpir.scene.placement import Placement, place_asset
from warpir.scene.receiver import ReceiverMesh, first_hit, mesh_of
from warpir.scene.shadow_mask import shadow_mask
from warpir.scene.tone_curves import Curves

DEPTH = 4
GROUND = 40.0
"""Half of the ground's side [m]."""
LIT_LEVEL = 0.35
"""Linear display value of sunlit ground [1]."""
CHANGE = 8.0 / 255.0
"""Display values by which the truth differs from the photo where the car changes it."""


@dataclass(frozen=True)
class Case:
    """Where the car stands, and where the sun is."""

    name: str
    sun_azimuth: float
    """Clockwise from the camera's direction [deg]."""
    place: tuple[float, float, float]
    rotate_y: float


CASES = (
    Case("in the wall's shadow", 15.0, (0.2, 0.0, -7.6), -35.0),
    Case("half in the wall's shadow", 15.0, (2.6, 0.0, -7.6), -55.0),
    Case("before the sunlit wall", 235.0, (0.2, 0.0, -8.2), -70.0),
)
BURIED = np.array([[1.0, 0, 0, 0], [0, 1, 0, -5], [0, 0, 1, 0], [0, 0, 0, 1]])
WALL_CENTRE, WALL_SIZE = np.array([0.6, 1.6, -9.2]), np.array([6.0, 3.2, 0.3])


def ground_and_wall() -> tuple[Asset, Asset]:
    """Return the ground, and the wall that stands on it."""
    paving = Material("paving", metallic=0.0, roughness=0.9, base_color_texture=TextureSlot(0))
    corners = GROUND * np.array([[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]], np.float64)
    uv = np.array([[0, 0], [8, 0], [8, 8], [0, 8]], np.float32)
    sides = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    ground = Asset(
        "ground", (Primitive(corners, sides, 0, uv0=uv),), (paving,), (paving_texture(512),)
    )
    brick = Material("brick", (0.3, 0.14, 0.08), metallic=0.0, roughness=0.95)
    return ground, Asset("wall", (box(WALL_CENTRE, WALL_SIZE),), (brick,))


def joined(parts: list[tuple[Asset, Float64Array]]) -> Asset:
    """Return several assets where they stand as one, in the world's frame."""
    primitives: list[Primitive] = []
    materials: list[Material] = []
    textures: list[Texture] = []
    for asset, matrix in parts:
        for p in asset.primitives:
            primitives.append(replace(place(p, matrix), material=p.material + len(materials)))
        for m in asset.materials:
            slots = {
                name: replace(slot, texture=slot.texture + len(textures))
                for name, slot in vars(m).items()
                if isinstance(slot, TextureSlot)
            }
            materials.append(replace(m, **slots))
        textures += asset.textures
    return Asset("place", tuple(primitives), tuple(materials), tuple(textures))


def photograph(asset: Asset, camera: Camera, texels: FloatArray, samples: int) -> PixelArray:
    """Return the place's linear radiance as Mitsuba path-traces it, the sky behind it."""
    shot = foreground(Setting(asset, np.eye(4), camera, texels), DEPTH, samples, 0)
    sky = look_up(texels, camera.pixel_rays())
    return np.asarray(shot.mean + (1.0 - shot.coverage)[..., None] * sky)


def painted_mask(wall: ReceiverMesh, camera: Camera, sun: Float64Array) -> FloatArray:
    """Return what a user would paint: ground that the wall keeps from the sun's centre."""
    rays = camera.pixel_rays().reshape(-1, 3)
    eye = np.broadcast_to(camera.c2w[:3, 3], rays.shape)
    to_wall = first_hit(wall, eye, rays)[0]
    to_ground = np.where(rays[:, 1] < 0.0, -eye[:, 1] / np.minimum(rays[:, 1], -1e-9), np.inf)
    points = eye + np.where(np.isfinite(to_ground), to_ground, 0.0)[:, None] * rays
    points[:, 1] = 1e-4
    shaded = np.isfinite(first_hit(wall, points, np.broadcast_to(sun, points.shape))[0])
    mask = shaded & (to_ground < to_wall)
    return mask.reshape(camera.height, camera.width).astype(np.float32)


@dataclass(frozen=True)
class Yard:
    """Ground, wall and car, and the camera that looks at them."""

    ground: Asset
    wall: Asset
    car: Asset
    camera: Camera
    samples: int
    """Of photo and truth, per pixel."""

    @property
    def place(self) -> list[tuple[Asset, Float64Array]]:
        """What stands in the photo.

        A second car, buried, lets photo and truth draw the same random numbers: Mitsuba draws one
        more where any material is transparent.
        """
        return [(self.ground, np.eye(4)), (self.wall, np.eye(4)), (self.car, BURIED)]

    @cached_property
    def meshes(self) -> tuple[ReceiverMesh, ReceiverMesh]:
        """The wall, and the wall with the ground."""
        return mesh_of(self.wall), mesh_of(joined(self.place[:2]))

    def empty(self, texels: FloatArray) -> tuple[float, PixelArray]:
        """Return the exposure, and the radiance of the place without the car."""
        radiance = photograph(joined(self.place), self.camera, texels, self.samples)
        lit = np.percentile(radiance[-self.camera.height // 4 :].mean(axis=-1), 60.0)
        return LIT_LEVEL / float(lit), radiance

    def changed_box(
        self, truth: PixelArray, photo: PixelArray, placement: Placement, device: str
    ) -> tuple[slice, slice]:
        """Return rows and columns of what the car changes clearly, its own pixels included."""
        difference = np.abs(truth - photo).mean(axis=-1)
        for axis in (0, 1):  # one path that meets the car far away is no change
            difference = sum(np.roll(difference, k, axis) for k in range(-2, 3)) / 5.0
        renderer = on_the_ground(self.car, placement.asset_to_world, self.camera, device)
        gbuffer = renderer.gbuffer(0)
        marked = difference > CHANGE
        marked.reshape(-1)[gbuffer.object_pixels[gbuffer.coverage > 0.0]] = True
        return mask_box(marked)

    def insertions(
        self, placement: Placement, light: Light, photo: Photo, mask: FloatArray, device: str
    ) -> dict[str, tuple[FloatArray, float]]:
        """Return the composites by what was known of the place, and seconds of the second render.

        Wall and ground together make the plane needless.
        """
        plain = Receiver(np.array([0.0, 1.0, 0.0]), 0.0)
        curves = Curves.identity("linear")
        radiance = photo_radiance(photo, curves)
        wall, whole = (replace(plain, mesh=mesh, radiance=radiance) for mesh in self.meshes)
        placed = Placed(self.car, placement.asset_to_world)
        shade = shadow_mask(mask, *self.car.bounds(), placed.asset_to_world, self.camera)
        quality = Quality(self.samples // 2, 1, DEPTH, 0)
        found = {}
        for name, proxy, own_mask in (
            ("plane", plain, None),
            ("plane and mask", plain, shade),
            ("plane and mesh", wall, None),
            ("mesh alone", replace(whole, is_plane=False), None),
        ):
            scene = Scene([placed], self.camera, proxy, device)
            for _ in range(2):
                start = time.perf_counter()
                given = light, light, photo, quality, curves
                picture = make_picture(Renderer(scene), *given, shadow_mask=own_mask)
                seconds = time.perf_counter() - start
            found[name] = (np.clip(picture.image, 0.0, 1.0), seconds)
        return found


def compare(
    case: Case, yard: Yard, texels: FloatArray, exposure: float, empty: PixelArray, device: str
) -> tuple[FloatArray, list[dict[str, Any]]]:
    """Render truth and insertions of a case; return the sheet's row and the figures.

    The light, texels of shape [256, 512, 3], has the sun where the case wants it. ``exposure`` is
    the display-linear value of a radiance of 1, ``empty`` the radiance of the place without the
    car, shape [H, W, 3].
    """
    camera, car = yard.camera, yard.car
    photo = photo_of(linear_to_gamma(np.clip(exposure * empty, 0.0, 1.0)))
    placement = place_asset(
        *car.bounds(), camera, None, place=case.place, rotate_y=case.rotate_y, size=2.2
    )
    with_car = joined([*yard.place, (car, placement.asset_to_world)])
    shot = photograph(with_car, camera, texels, yard.samples)
    truth = linear_to_gamma(np.clip(exposure * shot, 0.0, 1.0))
    # Below the horizon a panorama from there would show the ground.
    lower = texels.copy()
    lower[128:] = np.mean(empty[-camera.height // 8 :], axis=(0, 1))
    light = Light(texels=lower).scaled(exposure)
    mask = painted_mask(yard.meshes[0], camera, lamp_axes(Light(texels=texels))[0])
    found = yard.insertions(placement, light, photo, mask, device)
    box = yard.changed_box(truth, photo.srgb, placement, device)
    figures = [
        {
            "case": case.name,
            "known": name,
            "rmse_box": round(rmse(image[box].astype(np.float64), truth[box]), 4),
            "rmse_picture": round(rmse(image.astype(np.float64), truth), 4),
            "seconds": round(seconds, 2),
        }
        for name, (image, seconds) in found.items()
    ]
    tiles = [photo.srgb, *(image for image, _ in found.values()), truth]
    return np.concatenate(tiles, axis=1), figures


def main() -> None:
    """Render truth and insertions of every case; write the sheet and the figures."""
    parser = flags(__doc__, "device", "json")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--panorama", type=Path, default=LIGHT, help="default: the demo's sky")
    parser.add_argument("--samples", type=int, default=256, help="of truth and photo, per pixel")
    parser.add_argument("--width", type=int, default=480)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    device = choose_device(options.device)
    camera = camera_from_fov(options.width, options.width * 2 // 3, 58.0, -9.0, 1.9)
    yard = Yard(*ground_and_wall(), load_asset(ASSET), camera, options.samples)
    texels = read_envmap(options.panorama)
    azimuth = angles_from_axis(lamp_axes(Light(texels=texels))[0])[0]
    rows = []
    photos: dict[float, tuple[FloatArray, float, PixelArray]] = {}
    for case in CASES:
        if case.sun_azimuth not in photos:
            # Counter-clockwise, azimuths run clockwise.
            turned = resize_map(rotate_map(texels, azimuth - case.sun_azimuth), 256)
            photos[case.sun_azimuth] = (turned, *yard.empty(turned))
        row, lines = compare(case, yard, *photos[case.sun_azimuth], device)
        rows.append(row)
        for line in lines:
            report(line, options.json)
    write_picture(options.out / "proxy.png", np.concatenate(rows, axis=0))


if __name__ == "__main__":
    main()
