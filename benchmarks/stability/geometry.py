"""Hard cases of geometry: 1 mm and 10 km, 100 km away, contact, broken meshes, needles."""

from benchmarks.stability import broken, rays, shadows
from benchmarks.stability.case import MAX_ABSOLUTE, RELATIVE, SHARE, Case, Quantity, table

GROUP, RMS = "Geometry", "RMS absolute"
PLACES = {
    "1 mm wide": (1e-3, 0.0),
    "1 m wide": (1.0, 0.0),
    "10 km wide": (1e4, 0.0),
    "1 m wide, 100 km away": (1.0, 1e5),
    "1 mm wide, 100 km away": (1e-3, 1e5),
}
"""Size and distance from the origin [m]."""
TOUCHING = (
    {
        "box on the plane": (0.0, 1.0),
        "box on the plane, 1 mm wide": (0.0, 1e-3),
        "box on the plane, 10 km wide": (0.0, 1e4),
    },
    {
        "box sunk by 1e-3 of its size": (-1e-3, 1.0),
        "box sunk by 0.3 of its size": (-0.3, 1.0),
    },
)
"""Gap below the box over its size [1], and size [m]."""
ABOVE = {
    "box 1e-7 of its size above": (1e-7, 1.0),
    "box 1e-3 of its size above": (1e-3, 1.0),
    "box of 1 m, 1 cm above": (1e-2, 1.0),
}
"""The same."""

POSITION = 1e-6
"""Eight roundings of coordinates within half the diagonal, over slopes of 0.2 and more."""
SELF_HITS = 0.0
"""A convex body: no ray that leaves it meets it again."""
LEAKS = 0.0
"""A closed body, or one that stands in the plane: no ray gets out of it or below it."""
SHADOW = 4e-3
"""RMS noise of 4096 low-discrepancy samples per pixel, half of the binomial one."""
NORMAL_ROUNDINGS = 4.0
"""Roundings of 2^-24 of a vertex, at most half the diagonal away, over the needle's width."""
FLAT = 1e-6
"""A few roundings."""
FACETS = 1e-2
"""A sphere of 20 480 flat facets at 4096 samples a pixel against its curved truth, RMS."""
ALBEDO = 2e-3
"""Three deviations of the mean of eight times 65536 low-discrepancy samples."""
SAGITTA = 4e-6
"""Facets of 2 pi / 1000 lie ``(pi / 1000)^2 / 2 = 5e-6`` of the radius deep at most, share of the
diagonal 1.5e-6, and eight roundings more."""

OTHER_MATERIAL = "has no glTF material; benchmarks.referee compares whole pictures"


def needle_bound(width: float) -> float:
    """Return what rounding the vertices does to a needle's normal; the card is 1 to 1.4 m wide."""
    return NORMAL_ROUNDINGS * 2.0**-24 * 0.7 / width


def cases() -> list[Case]:
    """Return the rows of this group."""
    return [*in_places(), *near_the_plane(), *of_meshes(), *of_shading()]


def in_places() -> list[Case]:
    """Return the rows on size and distance."""
    away, shadow = rays.mitsuba_self_hits, shadows.square_shadow
    return table(
        GROUP,
        PLACES,
        Quantity("first hits", "max over the diagonal", rays.hits, POSITION, rays.mitsuba_hits),
        Quantity("rays that leave a ball", SHARE, rays.self_hits, SELF_HITS, away),
        Quantity("shadow of a square", RMS, shadow, SHADOW, shadows.mitsuba_square),
    )


def near_the_plane() -> list[Case]:
    """Return the rows on contact."""
    leak, theirs = shadows.contact_leak, shadows.mitsuba_contact_leak
    shadow = Quantity("shadow", RMS, shadows.contact, SHADOW, shadows.mitsuba_contact)
    below = Quantity("light below it", MAX_ABSOLUTE, leak, LEAKS, theirs)
    within = Quantity("light within it", SHARE, rays.dome_leaks, LEAKS, rays.mitsuba_dome)
    on, sunk = TOUCHING
    domes = {
        f"open dome of {size:g} m{', inside out' if reverse else ''}": (size, reverse)
        for size in (1e-3, 1.0, 1e4)
        for reverse in (False, True)
    }
    return [
        *table(GROUP, on, shadow, below),
        *table(GROUP, ABOVE, shadow),
        *table(GROUP, sunk, shadow, below),
        *table(GROUP, domes, within),
    ]


def of_meshes() -> list[Case]:
    """Return the rows on broken and thin meshes."""
    opaque = "has no ray query with transparency apart from its integrators"
    cards = {
        f"two cards in one place, {'against each other' if opposite else 'alike'}, "
        f"{'double' if double else 'single'} sided": (opposite, double)
        for opposite in (False, True)
        for double in (False, True)
    }
    flat, twins, sheets = (
        Quantity(name, MAX_ABSOLUTE, run, FLAT, mitsuba)
        for name, run, mitsuba in (
            ("coverage, position, normal", broken.degenerate, broken.mitsuba_degenerate),
            ("coverage, position, normal", broken.twins, "culls no faces"),
            ("sunlight through both, as one", broken.blended_twins, opaque),
        )
    )
    theirs = rays.mitsuba_needles
    needles = Quantity("position, normal", MAX_ABSOLUTE, rays.needles, needle_bound, theirs)
    return [
        *table(GROUP, {"triangles of no area": ()}, flat),
        *table(GROUP, cards, twins),
        *table(GROUP, {"two sheets of opacity 0.25 in one place": ()}, sheets),
        *table(GROUP, {needle_name(w): (w,) for w in (1e-2, 1e-3)}, needles),
        *table(GROUP, {needle_name(w): (w,) for w in (1e-4, 1e-5)}, needles),
    ]


def of_shading() -> list[Case]:
    """Return the rows on radiance, and on a mesh of two million triangles."""
    wound = {"wound as they should be": (False,), "inside out": (True,)}
    balls = {f"ball, triangles {name}": reverse for name, reverse in wound.items()}
    matt = Quantity("radiance", "RMS relative", broken.inside_out, FACETS, OTHER_MATERIAL)
    half = Quantity("coverage, radiance", RELATIVE, broken.one_pixel, ALBEDO, OTHER_MATERIAL)
    name, measure = "first hits, rays that leave", "max over the diagonal, share"
    many = Quantity(name, measure, rays.many_triangles, SAGITTA, rays.mitsuba_many_triangles)
    return [
        *table(GROUP, balls, matt),
        *table(GROUP, {"a view of one pixel": ()}, half),
        *table(GROUP, {"two million triangles": ()}, many, is_slow=True),
    ]


def needle_name(width: float) -> str:
    """Return the name of a card of needles."""
    return f"needles 1 m long, {width:g} m wide"
