"""The tuned numbers of the method of maps, with their units and reasons.

A plain fraction that explains itself stands where it is used. What drives tell is measured (`smal.teaching`).
"""

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class Settings:
    """Shares are of 1, lengths in correlation lengths unless a name says otherwise."""

    # -- the map (`smal.teaching`)
    #: Keyframes in a correlation length: between two of them a view hardly changes, and one further it is new.
    views_a_length: int = 5
    #: Or turned by so much: of the nearest keyframe a robot is then turned by about one virtual view at most.
    spacing_deg: float = 12.0
    #: Over this way wheels tell whether a person came back to where they were, and mended what they did.
    mended: float = 4.0
    aside: float = (
        0.4  # Virtual views are taken as far aside as two steps from keyframe to keyframe.
    )
    #: Turns of virtual views. 5 degrees are about twenty pixels, the width of a cell of HOG, within which a view stays
    #: alike; beyond 40 hardly anything of the taught image is left.
    turns_deg: tuple[float, ...] = tuple(5.0 * k for k in range(-8, 9))
    most_components: int = (
        400  # Principal components, at most so many: the map of 1 km at 2 m/s then takes 0.2 GB.
    )
    #: Components of variance v are divided by v to this power: half way to where all count alike. The largest ones are
    #: what many places share (sky, light), the smallest are noise.
    whitened: float = 0.25
    #: Two places of a drive that are further apart are different ones; further from its keyframe, a robot is lost.
    elsewhere: float = 4.0
    #: Share of views elsewhere whose distribution is taken as it is; that of the rest is an exponential tail.
    usual: float = 0.95
    reference: int = 256  # Views that say what elsewhere looks like.
    #: Views from which components are computed, and keyframes that are compared at once: memory.
    sampled_views: int = 2500
    compared_at_once: int = 32
    #: Looks of a keyframe at most, the taught one among them: more cost memory and time, and each can be mistaken.
    looks: int = 4
    look_from: float = (
        0.5  # A further look is warped from a frame that is nearer to its keyframe than this.
    )
    #: By so much, natural logarithms, a new map may make a view less likely: a hundredth of what views tell.
    may_lose: float = 0.05
    #: Keyframes at which a view is looked for anywhere, and leading components by which they are chosen on longer ways.
    looked_at: int = 500
    leading: int = 64

    # -- how alike views are (`smal.teaching.calibration`)
    #: Turned by less, a view is the same; by more, two views hardly overlap.
    same_deg: float = 3.0
    overlap_deg: float = 40.0
    reach: float = 0.2  # Views of one place are looked for over this share of the longest way.
    #: Frames of a drive, and pairs in curves, that are looked at: time grows with the square; a millisecond each.
    most_frames: int = 1000
    most_pairs: int = 500

    # -- the camera and the scene (`smal.camera`)
    #: Fields of view that are tried, of rectilinear and of equidistant lenses: those of cameras on robots; and those
    #: that are assumed where nothing tells how far it sees.
    fields_deg: tuple[float, ...] = tuple(range(40, 125, 5))
    wide_fields_deg: tuple[float, ...] = tuple(range(80, 205, 5))
    usual_field_deg: float = 70.0
    usual_wide_field_deg: float = 140.0
    #: Heights of the camera that are tried, and distances of the scene over that height.
    heights: tuple[float, ...] = tuple(0.1 * 1.5**k for k in range(7))
    distances: tuple[float, ...] = tuple(3.0 * 2.0**k for k in range(6))
    #: Pairs of views that a fit looks at: more change nothing that is seen; and frames between the two at most.
    pairs: int = 24
    most_apart: int = 100
    #: A larger turn tells the camera; a step that is turned by less tells the scene; atoms that turn by so much
    #: together tell how far one turns.
    tells_camera_deg: float = 9.0
    tells_scene_deg: float = 25.0
    tells_turn_deg: float = 15.0
    usual_turn_deg_s: float = (
        45.0  # How fast robots turn, where no drive turns and nothing else tells.
    )

    # -- the wheels (`smal.movement.MotionNoise`)
    #: Of the way, of a turn, and of the pace. Wheels slip a little, and those of two robots disagree by a twentieth. Of
    #: atoms only the usual movement is known: people drive half as fast, or half as fast again.
    wheels: tuple[float, float, float] = (0.05, 0.03, 0.05)
    atoms: tuple[float, float, float] = (0.1, 0.1, 0.5)
    pace: float = 10.0  # Way over which a pace lasts.
    #: Degrees of heading a correlation length, and at every new view: carpets, kerbs, and cameras that shake.
    drift_deg: float = 1.5
    jitter_deg: float = 1.0

    # -- the filter
    #: Probability, with each new view, that the robot was carried or the filter follows a wrong place; larger where the
    #: view is unlike the one before.
    jump: float = 5e-3
    #: Views that show nothing of the place, since something hides it; with each new view, the probability that it shows
    #: again, and that as much of it shows as in another light, which lasts for about fifty new views.
    hidden: float = 0.1
    appears: float = 0.5
    light: float = 0.02
    #: How far a view counts that nobody taught. What a robot sees that looks back is 2 (campus) to 9 times (indoors) as
    #: much evidence for other places as it should be. Counted by 0.7, one such view would be none; but views of one
    #: turn repeat each other.
    untaught: float = 0.3
    blind: float = 2.0  # Way without a view after which the wheels are believed half.
    #: Probability from which a place is one to look near after a jump; share of the way since that the wheels may err.
    located: float = 0.9
    slip: float = 0.1
    #: First belief: at the start of a taught drive, beside any way, lost; and how far the heading may be off there.
    first: tuple[float, float, float] = (0.5, 0.35, 0.15)
    first_turn_deg: float = 30.0
    start_s: float = 0.5  # Starts scatter by what is driven in this time.
    back: float = 0.05  # Lost robots that are beside the way again, with each new view.
    #: Particles of each set: more take longer and find no more; and keyframes to both sides among which one that moved
    #: finds its nearest.
    particles: int = 1000
    neighbours: int = 6

    # -- planning
    #: Places that a decision is made of, the heaviest.
    places: int = 64

    # -- what is sought (`smal.sought`)
    #: Time of driving before the end of a drive in which what it ends before may be seen well; and within which views
    #: show the same things.
    approach_s: float = 4.0
    beside_s: float = 3.0
    explaining: int = 60  # Views of the way that explain others.
    #: Shares of the cells of the way that are nearer to the rest of it: what is less near stands out; is not alike.
    stands_out: float = 0.98
    far: float = 0.999
    like: float = (
        0.7  # Share of how far a cell is from the way within which it is like what is followed.
    )
    sizes: int = 4  # Windows of different sizes.
    plain: float = 4.0  # Contrast of a picture, of 255, with less of which it shows nothing.
    #: Mean score where it is not in view, as a share of the best one of the approach, at least: round the end there are
    #: things that the way does not show.
    least_score: float = 0.025
    same_moment_s: float = 0.5  # Views of so long a time say together what one says.
    #: Probability that it is in view of a robot that has arrived and looks around; how much worse it is to say wrongly
    #: that it is there than to look on.
    in_view: float = 0.2
    false_seen: float = 40.0
    low: float = 0.1  # How low in the view it is tells how near it is, where that is so much at the end of the way.
    as_near: float = (
        1.3  # What is seen is found nearer than this many times how near the taught ways ended.
    )

    # -- what stands in the way (`smal.obstacles`), in radii of the robot
    depth_columns: int = 160  # That are looked at: half a degree apart, which is 4 cm at 5 m.
    #: Height over the plane from which something is no ground, metres, and what is added a metre ahead: what is left of
    #: noise and of a floor that is not quite even. A wheel climbs less.
    ground_m: float = 0.05
    ground_slope: float = 0.02
    tilt_deg: float = (
        5.0  # Pitch and roll, at most, of a camera that shakes, and of a kerb under a wheel.
    )
    least_pixels: int = 3  # Pixels of a column that must show a thing: fewer are noise.
    gap_rows: int = (
        5  # Rows of a column that may show no ground before it ends: specks without texture.
    )
    least_shown: float = 0.5  # Share of columns that must show the ground, or a thing before it.
    #: What a hit adds to the evidence of a cell, and its bounds: above 0 something stands there, below 0 it is free.
    #: Being seen through takes 1, so that what has walked away is forgotten within half a second.
    hit: int = 2
    most_evidence: int = 5
    least_evidence: int = -3
    #: What has come where it was free moves until it was seen there in so many looks, half a second; not within so many
    #: cells of what stands, since distances err by one, and edges with them. Out of view it is known for so many times
    #: as long as it was seen there; for ever, once that was for so many looks, 3 s.
    still: float = 5.0
    edge: int = 3
    lasts: float = 4.0
    stays: float = 30.0
    walks_m: float = (
        0.8  # Kept off what moves, metres: a person's 1.6 m/s (ISO 13855) for half a second.
    )
    sways_m: float = (
        0.1  # Who has come, and stands, is kept off so much further than things, metres.
    )
    deep: float = 2.0  # A thing goes on so far behind its face, where nobody has looked.
    cells_radius: int = 4  # Cells a radius.
    grid: int = 12  # How far the grid reaches: some 5 m for a robot of 0.4 m.
    margin: float = 0.25  # What stays between the robot and what it stops before.
    slowest: float = 0.05  # Slower than this share of its speed a robot stands.
    may_go_aside: float = (
        6.0  # From the taught way: 2.4 m for a robot of 0.4 m, where views are still known.
    )
    #: Distance from things beyond which more is of no use, and what a metre costs more right beside them.
    room: float = 2.0
    tight_cost: float = 2.0
    #: It waits so far before what it does not get round: nearer by that would hide all that it knows its way by.
    stands_before: float = 6.0
    most_turns: int = 180  # Turns to each side that are tried: a degree apart.
    #: What a metre costs more a correlation length beside the way, and over ground that nobody has seen.
    aside_cost: float = 1.5
    unknown_cost: float = 0.5

    # -- what is strange on the ground, without depth (`smal.obstacles.strange`)
    #: Half the width of what a robot sweeps, in heights of its camera: robots are about as wide as that is high.
    swept: float = 0.7
    strange_s: float = 0.2  # For so long, at least, it must be seen.
    strange_keyframes: int = 3  # To either side whose ground is known here.
    strange_views: float = (
        1e4  # One of so many views would be called strange: a kilometre of keyframes indoors.
    )
    #: Colours that are less apart are alike: a twelfth of the brightness, by light, exposure and compression.
    least_strange: float = 0.03
    patch_known: int = 6  # Of the nine cells of a patch that must lie on the swept ground.

    # -- stitches
    #: Keyframes that one drive may go on by while another goes on by one: drives stop, and turn elsewhere.
    advance: int = 3
    trusted: float = 3.0  # Standard deviations of odometry that are believed.


SETTINGS: Final = Settings()
