"""Every constant whose value somebody chose: where it is, on what it was chosen, what it does.

`GROUPS` holds the constants that were chosen by looking at scores, or by judgement, by what they belong to. `UNTUNED`
names all other numbers of the packages that solve for an asset, by why they are what they are; so a new constant that
is in neither is noticed by the tests. No value is written here: `constants_places.value_of` reads it from the code.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from constants_places import scaled

WALKER = "walker"
BOTH = "walker, runner"
ALL = "walker, runner, robot"
JUDGED = "by judgement"

NO_IMAGES = "the captures have images; it counts only for Gaussians without"
IMAGE_PATH = "only the image path uses it, the paper's recipe, which is not run here"
FINE_PIXELS = "it counts only where pixels are much finer than Gaussians; those of these captures are not"
LAMPS = "only lamps use it; relit views have none"
EXACT_MASKS = "masks of these captures are exact, and stay as they are"
MASKED = "these captures have masks; it counts only for photographs without"
EXACT_EXPOSURES = "exposures of these captures are equal, and colours stay as they are"
CLEAN_PHOTOGRAPHS = "photographs of these captures are clean, and noise asks for neither dropout nor total variation"
MANY_PHOTOGRAPHS = "these captures have so many photographs that opacities are not reset"
EXACT_RIGS = "cameras of these captures are exact, and stay as they are"
SCENE_LINEAR = "the captures are scene-linear, so that no exposure is looked for"
FAR_MOTION = "only motion beyond the reach of reduced images uses it, which these frames do not have"
NO_SCORE = "it decides what is reported, and moves no score"
ONE_FRAME = "the runs have one frame or two, of which none is left out"
BINARY = "a list of powers of two"


SIDES = ("less", "more")
"""Where other values are tried: half of the value, and as much more or what `Constant.more` says."""

HALF = 0.5


@dataclass(frozen=True)
class Constant:
    """A constant that was chosen.

    Attributes:
        place: Where it is; see `constants_places`. Several that make sense only together are separated by spaces.
        chosen_on: What it was chosen on.
        does: What it does, one sentence.
        not_varied: Why nothing is measured; empty for a constant that is varied.
        most: Largest value that it can have.
        more: What it is multiplied by for more of it.
    """

    place: str
    chosen_on: str
    does: str
    not_varied: str = ""
    most: float = math.inf
    more: float = 1.5

    @property
    def places(self) -> tuple[str, ...]:
        """The places, at least one."""
        return tuple(self.place.split())

    def tried(self, side: str, value: Any) -> Any:
        """Return what is tried in place of a value: on the side of ``"less"``, or of ``"more"``."""
        return scaled(value, self.more if side == "more" else HALF, self.most)

    @property
    def name(self) -> str:
        """What it is called on pages: without modules."""
        return ", ".join(place.partition(":")[2] for place in self.places)


FIT = "beam_warp.reconstruction.fit:"
REFLECTIONS = "beam_warp.reconstruction.reflections:"
INITIAL = "beam_warp.reconstruction.initial:"
TRACK = "beam_warp.reconstruction.track:"
JOINTS = "beam_warp.reconstruction.joint_tracking:"
FAR = "beam_warp.reconstruction.far_motion:"
REGISTRATION = "beam_warp.reconstruction.joints.registration:"
ROUGH = "beam_warp.decomposition.roughness_finder:"
EVIDENCE = "beam_warp.materials.evidence:"
ROUGHNESS = "beam_warp.materials.roughness:"
RESIDUES = "beam_warp.kernels.materials.residues:"
SEEN_COLORS = "beam_warp.kernels.reconstruction.seen_colors:"
DEFERRED = "beam_warp.render.options:DeferredOptions."
SHADOWS = "beam_warp.kernels.render.shadow_maps:"
SOURCES = "beam_warp.light.compact_sources:"
VERTICES = "beam_warp.kernels.render.path_vertices:"

RECONSTRUCTION = (
    Constant(FIT + "FitOptions.color_iterations", WALKER, "Steps without the term of normals."),
    Constant(FIT + "FitOptions.normal_iterations", WALKER, "Steps with it."),
    Constant(FIT + "FitOptions.weights.l1", "3DGS", "Weight of colour.", "only its ratio to the others counts"),
    Constant(FIT + "FitOptions.weights.ssim", "3DGS", "Weight of structural similarity."),
    Constant(FIT + "FitOptions.weights.alpha", ALL, "Weight of coverage."),
    Constant(FIT + "FitOptions.weights.estimated", "walker, robot", "Part of it for estimates.", EXACT_MASKS, most=1.0),
    Constant(FIT + "FitOptions.weights.normal", ALL, "Weight of normals against the depth's."),
    Constant(FIT + "FitOptions.weights.normal_tolerance", ALL, "Angle of an edge [rad]."),
    Constant(FIT + "FitOptions.rates.positions", WALKER, "Step of positions, in distances of the cameras."),
    Constant(FIT + "FitOptions.rates.orientations", WALKER, "Step of orientations."),
    Constant(FIT + "FitOptions.rates.scales", WALKER, "Step of the logarithms of scales."),
    Constant(FIT + "FitOptions.rates.opacities", WALKER, "Step of the logits of opacities."),
    Constant(FIT + "FitOptions.rates.color", WALKER, "Step of the mean colour."),
    Constant(FIT + "FitOptions.rates.bands", WALKER, "Step of colour that depends on direction."),
    Constant(FIT + "FitOptions.rates.final_positions", "3DGS", "Part of the positions' step at the end.", most=1.0),
    Constant(FIT + "FitOptions.rates.final_others", WALKER, "Part of all other steps at the end.", most=1.0),
    Constant(FIT + "FitOptions.sh_degree", WALKER, "Degree of the captured radiance."),
    Constant(FIT + "FitOptions.raster.low_pass", WALKER, "Variance of the pixel filter [pixel²]."),
    Constant(FIT + "FitOptions.refine_every", WALKER, "Steps between refinements."),
    Constant(FIT + "FitOptions.refine_until", WALKER, "Part of all steps after which none is refined.", most=1.0),
    Constant(FIT + "FitOptions.split_fraction", WALKER, "Most that a refinement splits.", most=1.0),
    Constant(FIT + "FitOptions.hidden_share", WALKER, "Share of all weights that those dropped together hold."),
    Constant(FIT + "FitOptions.dead_opacity", JUDGED, "Opacity below which a Gaussian is dropped."),
    Constant(FIT + "RENEW_EVERY", JUDGED, "Steps between updates of the sampling filter."),
    Constant(
        FIT + "LEAST_GAIN",
        JUDGED,
        "Gain for which Gaussians are doubled again [dB].",
        "only fits to a target PSNR do so",
    ),
    Constant(
        FIT + "FEWEST_GAUSSIANS", JUDGED, "Gaussians that such a fit begins with.", "only fits to a target PSNR do so"
    ),
    Constant("beam_warp.reconstruction.densify:SPLIT_OFFSET", WALKER, "How far halves go apart, in deviations."),
    Constant("beam_warp.reconstruction.densify:SPLIT_SHRINK", WALKER, "How long a half is.", most=1.0),
    Constant(
        "beam_warp.raster.resolution:DISC_WIDTH",
        WALKER,
        "Deviation of the first discs, in spacings; also the unit of samples.",
    ),
    Constant(INITIAL + "DISC_THICKNESS", WALKER, "Their deviation along the normal, likewise."),
    Constant(INITIAL + "DISC_OPACITY", WALKER, "Their opacity.", most=0.99),
    Constant(INITIAL + "RELAXATIONS", JUDGED, "Rounds in which first points push each other apart."),
    Constant(
        INITIAL + "BALL_OPACITY", "3DGS", "Opacity of balls at given points.", "the captures have masks, and so discs"
    ),
    Constant(
        INITIAL + "HIDING_OPACITY", JUDGED, "Opacity of what hides others when first colours are seen.", most=0.99
    ),
    Constant(INITIAL + "DEPTH_SLACK", JUDGED, "How far behind the surface is still seen, in scales."),
    Constant(INITIAL + "LEAST_FACING", JUDGED, "Cosine below which a view says nothing of a point.", most=1.0),
    Constant(
        "beam_warp.kernels.reconstruction.even_points:STEP beam_warp.kernels.reconstruction.even_points:LONGEST_STEP",
        JUDGED,
        "How far points move when they are pushed apart.",
    ),
    Constant(
        SEEN_COLORS + "RELATIVE_SPREAD " + SEEN_COLORS + "LEAST_SPREAD",
        JUDGED,
        "Deviation at which a view's colour counts half.",
    ),
    Constant(SEEN_COLORS + "LEAST_COVERAGE", JUDGED, "Coverage below which a pixel's colour does not count.", most=1.0),
    Constant("beam_warp.reconstruction.targets:MATTE_SHARE", ALL, "Coverage's weight before a backdrop.", EXACT_MASKS),
    Constant("beam_warp.raster.resolution:SAMPLES_PER_SPACING", WALKER, "Samples on the distance of neighbours."),
    Constant("beam_warp.raster.resolution:MOST_SAMPLES", WALKER, "Largest side of a pixel's square of samples."),
    Constant("beam_warp.reconstruction.targets:CROP_MARGIN", JUDGED, "Pixels around the subject that are looked at."),
    Constant("beam_warp.reconstruction.hull:AUTO_RESOLUTION", JUDGED, "Least and most voxels along the visual hull."),
    Constant("beam_warp.reconstruction.hull:VOXEL_PIXELS", JUDGED, "Pixels across a voxel."),
    Constant(
        "beam_warp.reconstruction.gains:EXPOSURE_STOPS",
        "walker, runner, demo figure",
        "Difference of exposure that is undone [stop].",
    ),
    Constant(
        "beam_warp.reconstruction.gains:CLEAR_OF_RESIDUALS",
        "walker, runner, demo figure",
        "How far it must stand out from what is left unexplained.",
    ),
    Constant(
        "beam_warp.reconstruction.gains:LEAST_RESIDUAL", JUDGED, "Differences below count by their squares [stop]."
    ),
)

TRACKING = (
    Constant(TRACK + "GAUSSIANS_PER_JOINT", WALKER, "Gaussians for each joint."),
    Constant(JOINTS + "RATES_EVERY", JUDGED, "Steps between changes of the joints' rates."),
    Constant(JOINTS + "GAUSSIANS_PER_PIXEL", WALKER, "Gaussians for a pixel and side in reduced images."),
    Constant(TRACK + "JOINT_LIMITS", WALKER, "Fewest and most joints.", "neither limit is met with 20,000 Gaussians"),
    Constant(TRACK + "SMALLEST_COSINE", BOTH, "Cosine of normals below which neighbours are of two limbs.", most=1.0),
    Constant(TRACK + "TrackOptions.joints.levels", WALKER, "Reductions of the images, coarse to fine.", BINARY),
    Constant(TRACK + "TrackOptions.joints.iterations", WALKER, "Steps of each."),
    Constant(TRACK + "TrackOptions.joints.weights.l1", "3DGS", "Weight of colour.", "only its ratio counts"),
    Constant(TRACK + "TrackOptions.joints.weights.ssim", "3DGS", "Weight of structural similarity."),
    Constant(TRACK + "TrackOptions.joints.weights.alpha", WALKER, "Weight of coverage."),
    Constant(
        TRACK + "TrackOptions.joints.weights.estimated", WALKER, "Part of it for estimates.", EXACT_MASKS, most=1.0
    ),
    Constant(TRACK + "TrackOptions.joints.rigidity", WALKER, "Stiffness between joints."),
    Constant(TRACK + "TrackOptions.joints.rotation_rate", WALKER, "Step of joints' turns."),
    Constant(TRACK + "TrackOptions.joints.position_rate", WALKER, "Step of joints' positions, in their spacings."),
    Constant(TRACK + "TrackOptions.joints.final_rate", WALKER, "Part of both at the end of a level.", most=1.0),
    Constant(TRACK + "TrackOptions.refinement.normal_iterations", WALKER, "Steps of Gaussians after the joints."),
    Constant(TRACK + "TrackOptions.refinement.rates.positions", WALKER, "Step of positions then."),
    Constant(TRACK + "TrackOptions.refinement.rates.orientations", WALKER, "Step of orientations."),
    Constant(TRACK + "TrackOptions.refinement.rates.scales", WALKER, "Step of scales."),
    Constant(TRACK + "TrackOptions.refinement.rates.opacities", WALKER, "Step of opacities."),
    Constant(TRACK + "TrackOptions.refinement.rates.color", WALKER, "Step of the mean colour."),
    Constant(TRACK + "TrackOptions.refinement.rates.bands", WALKER, "Step of colour that depends on direction."),
    Constant(
        TRACK + "TrackOptions.refinement.rates.final_positions", WALKER, "Part of positions' at the end.", most=1.0
    ),
    Constant(
        TRACK + "TrackOptions.refinement.rates.final_others", WALKER, "Part of others' at the end.", "1: constant"
    ),
    Constant(TRACK + "TrackOptions.refinement.temporal", WALKER, "Pull towards the frame before."),
    Constant(
        "beam_warp.reconstruction.temporal:TemporalTerms.UNITS",
        JUDGED,
        "Change of each attribute that counts as one.",
        "together they act as the pull's inverse square",
    ),
    Constant("beam_warp.reconstruction.joints.graph:REACH", WALKER, "Reach of a joint's weight, in spacings."),
    Constant(
        "beam_warp.reconstruction.joints.graph:SMALLEST_COSINE",
        BOTH,
        "The same cosine for graphs without a stated one.",
        "the tracker states its own",
    ),
    Constant("beam_warp.reconstruction.joints.graph:CANDIDATES", JUDGED, "Neighbours looked at for one that is kept."),
    Constant("beam_warp.reconstruction.joints.graph:JointGraph.build(neighbor_count)", BOTH, "Neighbours of a joint."),
    Constant("beam_warp.reconstruction.joints.skinning:Anchors.fit(neighbor_count)", BOTH, "Joints of a Gaussian."),
    Constant("beam_warp.reconstruction.joints.selection:OVERSAMPLING", BOTH, "Candidates for a joint."),
    Constant("beam_warp.reconstruction.joints.selection:NEIGHBORS", JUDGED, "Neighbours of one that is not astray."),
    *(
        Constant(f"beam_warp.reconstruction.fit:{name}", chosen_on, does, CLEAN_PHOTOGRAPHS)
        for name, chosen_on, does in (
            ("DROPOUT_OF_NOISE", ALL, "Part that a step leaves out, over noise and what a pixel has too many."),
            ("LEAST_DROPOUT", JUDGED, "Part below which none is left out."),
            ("MOST_DROPOUT", JUDGED, "Largest part that is left out."),
        )
    ),
    *(
        Constant(f"beam_warp.reconstruction.total_variation:{name}", chosen_on, does, CLEAN_PHOTOGRAPHS)
        for name, chosen_on, does in (
            ("VARIATION_OF_NOISE", ALL, "Weight of the total variation of radiance, over the variance of noise."),
            ("LEAST_VARIATION", JUDGED, "Weight below which it does not count."),
            ("MOST_VARIATION", ALL + ", a painted ball", "Largest weight."),
            ("NEIGHBORS", JUDGED, "Neighbours that radiance is compared with."),
            ("ROUNDING", JUDGED, "Difference below which it counts by its square."),
        )
    ),
    Constant(
        FIT + "FitOptions.reflect_until", "walker, robot", "Part of the steps in which Gaussians reflect.", most=1.0
    ),
    Constant(FIT + "FitOptions.rates.gloss", JUDGED, "Step of the logits of roughness and openness."),
    Constant(FIT + "BANDS_BESIDE", "walker, robot", "Rate of harmonics beside reflections, over that without."),
    Constant(REFLECTIONS + "FIRST_GLOSS", JUDGED, "Logits that roughness and openness begin with."),
    Constant(REFLECTIONS + "RIDGE", JUDGED, "Weight of small coefficients of what is reflected."),
    Constant(REFLECTIONS + "DIRECTIONS", JUDGED, "Directions by which coefficients are found."),
    *(
        Constant("beam_warp.kernels.reconstruction.reflections:" + name, JUDGED, does)
        for name, does in (
            ("LEAST_ROUGHNESS", "Least roughness of a Gaussian that reflects."),
            ("LEAST_FACING", "Least cosine by which it reflects."),
            ("LOGIT_STEP", "Half the difference by which its slope is found."),
        )
    ),
    Constant(FIT + "EARLY_DROPOUT", ALL, "Part that a step leaves out in the first half, where it can be spared."),
    Constant(FIT + "NEEDED", "a painted ball", "Gaussians that a pixel of the subject needs."),
    *(
        Constant(FIT + name, ALL, does, MANY_PHOTOGRAPHS)
        for name, does in (
            ("PLENTY", "Photographs from which on opacities are not reset, nor Gaussians and steps saved."),
            ("RESET_OPACITY", "Most opacity after a reset."),
            ("RESET_AFTER", "Part of all steps before it."),
            ("RESET_STEPS", "Fewest steps of a fit that has one."),
        )
    ),
    Constant(FIT + "FitOptions.reset_below", ALL, "Photographs from which on there is none.", MANY_PHOTOGRAPHS),
    Constant(TRACK + "TrackOptions.reach", WALKER, "Pixels from which on silhouettes are asked.", FAR_MOTION),
    Constant(FAR + "MOST_NODES " + FAR + "POINTS_PER_NODE", WALKER, "Points of either surface.", FAR_MOTION),
    Constant(FAR + "HULL_RESOLUTION", JUDGED, "Voxels of the hull that joints are moved to.", FAR_MOTION),
    Constant(FAR + "ASTRAY", JUDGED, "Part of the joints that may be astray.", FAR_MOTION),
    Constant(REGISTRATION + "WIDTHS", WALKER, "Width of shares, in distances of neighbours.", FAR_MOTION),
    Constant(REGISTRATION + "GIVE", WALKER, "Deviation of an edge from rigid, likewise.", FAR_MOTION),
    Constant(REGISTRATION + "FACING", WALKER, "Deviation of normals.", FAR_MOTION),
    Constant(REGISTRATION + "STRAY", JUDGED, "Share of what nothing explains.", FAR_MOTION),
    Constant(REGISTRATION + "ROUNDS " + REGISTRATION + "TURNS", WALKER, "Rounds of moving.", FAR_MOTION),
    Constant(TRACK + "TrackOptions.largest_drop", WALKER, "Loss of PSNR at which tracking is lost [dB].", NO_SCORE),
    Constant(TRACK + "TrackOptions.largest_gap", WALKER, "Uncovered part at which it is lost.", NO_SCORE),
    Constant(TRACK + "TrackOptions.largest_tear", WALKER, "Part of torn joints at which it is lost.", NO_SCORE),
    Constant(TRACK + "NOISE_PSNR", JUDGED, "PSNR above which a fit is of noise [dB].", NO_SCORE),
    Constant(
        "beam_warp.reconstruction.steps:MOST_UNPAIRED", JUDGED, "Part seen by one view that is reported.", NO_SCORE
    ),
    Constant("beam_warp.reconstruction.steps:DOUBTFUL_TEAR", WALKER, "Part of torn joints that is reported.", NO_SCORE),
    Constant("beam_warp.reconstruction.steps:STRUCTURE_REACH", JUDGED, "Pixels that tracking reaches.", NO_SCORE),
    Constant("beam_warp.reconstruction.frames.report:DRIFT_WARNING", JUDGED, "Drift that is reported.", NO_SCORE),
)

MESHING = (
    Constant("beam_warp.mesh.consistency:TOLERANCE", BOTH, "Distance within which views agree [pixel]."),
    Constant("beam_warp.mesh.extract:mesh_of_gaussians(confirmations)", BOTH, "Views that must confirm a pixel."),
    Constant("beam_warp.mesh.extract:mesh_of_gaussians(smallest_part)", JUDGED, "Smallest part that is kept."),
    Constant("beam_warp.mesh.depths:MINIMUM_ALPHA", "RaDe-GS", "Coverage from which on there is a surface.", most=0.99),
    Constant("beam_warp.kernels.mesh.depth_pixels:LARGEST_TILT", JUDGED, "Tangent beyond which a surface is an edge."),
    Constant("beam_warp.kernels.mesh.depth_pixels:LEAST_COSINE", JUDGED, "Cosine below which a pixel does not count."),
    Constant("beam_warp.kernels.mesh.tsdf:LEAST_WEIGHT", JUDGED, "Weight from which on a voxel was seen."),
)

MATERIALS = (
    Constant("beam_warp.materials.light_rays:MaterialOptions.sample_count", BOTH, "Rays of a Gaussian.", more=2.0),
    Constant("beam_warp.materials.light_rays:MaterialOptions.light_error", BOTH, "Error at which rays are as many."),
    Constant("beam_warp.materials.pilot:REACH", BOTH, "Neighbours whose rays tell how many a Gaussian needs."),
    Constant("beam_warp.materials.light_rays:BOUNCE_PART", BOTH, "Rays for one of the bounce."),
    Constant(ROUGH + "ROUGHNESS_FRAMES", WALKER, "Most frames that roughness is found from.", ONE_FRAME),
    Constant(ROUGH + "PILOT_GAUSSIANS", JUDGED, "Gaussians that tell whether views say anything of roughness."),
    Constant(ROUGH + "LEAST_SAVED", JUDGED, "How many times as many Gaussians a frame has for a pilot."),
    Constant("beam_warp.materials.direct:BURIED_VISIBILITY", JUDGED, "Visibility below which light is not traced."),
    Constant("beam_warp.materials.normals:LAYER_REACH", JUDGED, "How far from the surface a Gaussian is of a layer."),
    Constant("beam_warp.materials.normals:FACE_SPREAD", BOTH, "Normals of one face, beside an edge [rad]."),
    Constant("beam_warp.materials.normals:FACE_PASSES", BOTH, "Rounds of averaging over a face."),
    Constant("beam_warp.materials.normals:FACE_NEIGHBORS", ALL, "Neighbours among which faces are looked for."),
    Constant("beam_warp.materials.normals:FLAT_SPREAD", ALL, "Normals within a flat face [rad]."),
    Constant("beam_warp.materials.normals:LEAST_FLAT", ALL, "Part of a neighbourhood that must be as flat."),
    Constant("beam_warp.materials.normals:FACE_AROUND", ALL, "Width of a neighbourhood [spacing]."),
    Constant("beam_warp.materials.normals:FACE_REACH", ALL, "Distance to a face whose normal is taken [spacing]."),
    Constant("beam_warp.materials.normals:OFF_PLANE", ALL, "Distance from its plane [spacing]."),
    Constant("beam_warp.materials.normals:FACE_TURN", ALL, "How far a normal turns to that of a face [rad]."),
    Constant("beam_warp.materials.normals:LEAST_TOWARDS", JUDGED, "An own axis that faces as pixels see."),
    Constant(EVIDENCE + "LEAST_WEIGHT", BOTH, "Samples that must show a Gaussian for it to be seen."),
    Constant("beam_warp.materials.blended_color:SMOOTHNESS", ALL, "What differences between neighbours count."),
    Constant("beam_warp.materials.blended_color:CONTRAST", ALL, "Difference of neighbours at which it counts half."),
    Constant("beam_warp.materials.blended_color:EDGE", ALL, "Difference of neighbours that is no edge."),
    Constant("beam_warp.materials.blended_color:PASSES", ALL, "Passes over the views for base colour."),
    Constant("beam_warp.materials.blended_color:NEIGHBORS", JUDGED, "Gaussians around one that it is compared with."),
    Constant("beam_warp.materials.blended_color:BRIGHTEST", JUDGED, "Base colour that solving begins with, at most."),
    Constant(EVIDENCE + "LEAST_SHARE", BOTH, "Part of its own pixels that they must be."),
    Constant(EVIDENCE + "LEAST_AGREEMENT", JUDGED, "Agreement of normals below which there is none."),
    Constant(
        "beam_warp.kernels.materials.view_evidence:LEAST_SURFACE_ALPHA",
        BOTH,
        "Coverage by Gaussians from which on a pixel shows a surface.",
        most=0.999,
    ),
    Constant(
        "beam_warp.kernels.materials.view_evidence:LEAST_COVERAGE",
        BOTH,
        "Coverage in the image from which on its colour counts.",
        most=0.999,
    ),
    Constant(RESIDUES + "LEAST_VIEW_COSINE", JUDGED, "Cosine below which a view has no residue."),
    Constant(RESIDUES + "GRAZING " + RESIDUES + "FACING", BOTH, "Cosines where views begin to count, and count fully."),
    Constant(RESIDUES + "RELATIVE_SPREAD " + RESIDUES + "LEAST_SPREAD", BOTH, "Residual at which a view counts half."),
    Constant(RESIDUES + "ROUNDS", JUDGED, "Rounds of reweighting views."),
    Constant(
        "beam_warp.kernels.materials.roughness_profile:SPREAD_PART",
        BOTH,
        "Residual at which a view of gloss counts half.",
    ),
    Constant(
        "beam_warp.kernels.materials.roughness_profile:SHARE_ROUGHNESS",
        JUDGED,
        "Roughnesses at which a lobe's open share is summed.",
        most=1.0,
    ),
    Constant(ROUGHNESS + "CLUSTER", BOTH, "Gaussians that are asked together."),
    Constant(ROUGHNESS + "NEAR " + ROUGHNESS + "WIDE", BOTH, "Clusters of a place and of its surroundings."),
    Constant(ROUGHNESS + "PARENTS", JUDGED, "Clusters that a Gaussian is told by."),
    Constant(ROUGHNESS + "SHARED", BOTH, "Part of the agreement of halves that counts.", most=1.0),
    Constant(ROUGHNESS + "COMPARED", JUDGED, "Gaussians around a place whose halves are compared."),
    Constant(ROUGHNESS + "LEAST_AGREEMENT", JUDGED, "Logarithm of the odds for any claim."),
    Constant(ROUGHNESS + "RoughnessPrior(mean)", JUDGED, "Roughness where nothing is known."),
    Constant(ROUGHNESS + "RoughnessPrior(spread)", JUDGED, "Its spread."),
    Constant(ROUGHNESS + "INFORMED_PART", JUDGED, "Spread from which on the prior tells.", NO_SCORE),
    Constant(ROUGHNESS + "MODEL_ERROR", "what is pooled is not of one roughness", "Error that is stated.", NO_SCORE),
    Constant("beam_warp.materials.base_color:UNLIT_PART", JUDGED, "Part of the mean light below which it is unlit."),
    Constant("beam_warp.materials.base_color:FACING_PART", JUDGED, "Part that must be seen from the front."),
    Constant("beam_warp.materials.base_color:FILL_NEIGHBORS", JUDGED, "Neighbours that fill what was not seen."),
    Constant(
        "beam_warp.materials.base_color:SATURATED_PART", JUDGED, "Part cut at a ceiling that is flagged.", NO_SCORE
    ),
    Constant(
        "beam_warp.materials.base_color:UNCERTAIN_NORMAL", "fog, spheres", "Confidence that is flagged.", NO_SCORE
    ),
    Constant("beam_warp.materials.base_color:POOLED_VIEWS", JUDGED, "Views pooled for standard errors.", NO_SCORE),
    Constant("beam_warp.materials.base_color:SPECULAR_PART", JUDGED, "Least of stated relative errors.", NO_SCORE),
    Constant(EVIDENCE + "HEADROOM", JUDGED, "Part of a ceiling that counts as cut.", "the captures are not cut"),
    Constant("beam_warp.materials.direct:SATURATION", JUDGED, "Display colour that counts as cut.", NO_IMAGES),
    Constant("beam_warp.materials.light_rays:VIEW_COUNT", JUDGED, "Directions that colour is read at.", NO_IMAGES),
    Constant("beam_warp.materials.light_rays:SMALLEST_VIEW_COSINE", JUDGED, "Their least cosine.", NO_IMAGES),
    Constant("beam_warp.materials.normals:NEIGHBOR_COUNT", "spheres, planes", "Neighbours of a normal.", NO_IMAGES),
    Constant("beam_warp.materials.normals:FLAT_RATIO", "spheres, planes", "Flatness that tells a normal.", NO_IMAGES),
    Constant("beam_warp.materials.normals:ORIENTATION_RAYS", JUDGED, "Rays that find the open side.", NO_IMAGES),
    Constant("beam_warp.materials.normals:SMOOTHING_PASSES", JUDGED, "Rounds of smoothing normals.", NO_IMAGES),
    Constant("beam_warp.trace.rays:LIFT_IN_THICKNESSES", "tiled planes, spheres, bowls", "Lift of rays.", NO_IMAGES),
    Constant(
        "beam_warp.materials.exposure:BRIGHTEST", JUDGED, "Brightest base colour, and its quantile.", SCENE_LINEAR
    ),
    Constant("beam_warp.materials.exposure:MISFIT_SLACK", JUDGED, "Misfits that are equally good.", SCENE_LINEAR),
    Constant("beam_warp.materials.exposure:DOUBT", JUDGED, "Standard errors that are no evidence.", SCENE_LINEAR),
    Constant("beam_warp.materials.exposure:WELL_LIT_PART", JUDGED, "Light of those that are asked.", SCENE_LINEAR),
    *(
        Constant(
            f"beam_warp.materials.changes:{name}", WALKER, does, "one frame is decomposed here; several are tested"
        )
        for name, does in (
            ("FALSE_DISCOVERIES", "Part said to change that may not."),
            ("LEAST_CHANGE", "Change that is worth a colour for every frame."),
            ("REFERENCE_QUANTILE", "Quantile that errors are scaled by."),
        )
    ),
    *(
        Constant(f"beam_warp.materials.light:{name}", BOTH, does, NO_SCORE)
        for name, does in (
            ("TOO_BRIGHT", "Base colour that says that light is too dim."),
            ("TOO_DARK", "Base colour that says that light is too bright."),
            ("WELL_SEEN", "Pixels of Gaussians that are asked."),
            ("AGREEMENT", "Agreement of their normals."),
            ("UNCUT", "Largest part of them that was cut."),
            ("WELL_LIT", "Light of those that are asked for exposure."),
            ("BRIGHT", "Quantile of the brighter base colours."),
            ("BRIGHTEST", "Quantile of the brightest."),
            ("PLAUSIBLE", "Base colour that a proposed exposure leads to."),
        )
    ),
    *(
        Constant(f"beam_warp.materials.light_fits:{name}", JUDGED, does, NO_SCORE)
        for name, does in (
            ("GLOSS_ROUGHNESS", "Roughness that light is mirrored in."),
            ("LARGEST_CHANGE", "Change of luminance that still counts."),
            ("NEIGHBORS", "Neighbours whose base colours are compared."),
            ("LEAST_GAIN", "Difference of misfit that matters."),
            ("GLOSSY_PART", "Change that can be told from noise."),
        )
    ),
    *(
        Constant(f"beam_warp.reconstruction.photometry:{name}", ALL, does, EXACT_EXPOSURES)
        for name, does in (
            ("LEVELS", "Levels of roughness whose highlights explain those of all others."),
            ("NEIGHBORS", "Gaussians over which normals are averaged."),
            ("SMOOTHEST", "Part of the points that is compared, where normals agree most."),
            ("DARKEST", "Colour of points that are left out, of the median."),
            ("LEAST_CHANCE", "Least probability of a roughness."),
            ("LEAST_SPREAD", "Least standard deviation of a colour."),
            ("MODEL_ERRORS.exposure", "Error of exposures that halves of the points share [logarithm]."),
            ("MODEL_ERRORS.balance", "Error of white balances that halves of the points share [logarithm]."),
            ("MODEL_ERRORS.falloff", "Error of the power of vignetting that halves of the points share."),
            ("MATTE_ERRORS.exposure", "Error of exposures where the light is not known [logarithm]."),
            ("MATTE_ERRORS.balance", "Error of white balances where the light is not known [logarithm]."),
            ("MATTE_ERRORS.falloff", "Error of the power of vignetting where the light is not known."),
            ("LEAST_MATTE_VIEWS", "Views that a point is seen by at least, where the light is not known."),
            ("LEAST_OF_VIEW", "Points that tell a view's gains, over those that the middle view sees."),
            ("LARGEST_GAIN", "Largest gain [logarithm]."),
        )
    ),
    *(
        Constant(f"beam_warp.{place}", "photographs of a statue", does, MASKED)
        for place, does in (
            ("reconstruction.steps:COMPARED", "Points at which exposures are compared."),
            ("reconstruction.stereo:ROUNDS", "Times that pixels improve their planes at a level."),
            ("reconstruction.stereo:AGREEMENTS", "Times that views look at each other's depths."),
            ("reconstruction.stereo:MOST_NEIGHBORS", "Views that a view is compared with."),
            ("reconstruction.stereo:WIDEST", "Angle between views that are compared [degree]."),
            ("reconstruction.stereo:DEPTHS", "Depths that are looked for, over the distance of the middle."),
            ("reconstruction.stereo:LARGEST_COST", "Cost up to which a plane counts."),
            ("reconstruction.stereo:LARGEST_STEP", "Distance of neighbours from a plane [pixel]."),
            ("reconstruction.stereo:LEAST_SHARE", "Part of an image that is a surface."),
            ("reconstruction.stereo:SMALLEST_PART", "Parts of the surface that are left out."),
            ("reconstruction.unmasked:PIXELS_PER_DISC", "Pixels of a view for each Gaussian."),
            ("reconstruction.unmasked:ELSEWHERE_SHARE", "Most of the Gaussians beside the surface."),
            ("reconstruction.unmasked:ELSEWHERE_OPACITY", "Opacity of discs whose depth is not known."),
            ("reconstruction.unmasked:EDGE", "Difference of colours across which depth may jump."),
            ("reconstruction.unmasked:LEAST_TIE", "Least tie of neighbouring pixels."),
            ("reconstruction.unmasked:FAR_TIE", "Tie of pixels of unknown depth to the farthest."),
            ("reconstruction.unmasked:SEEN_THROUGH", "Part of the depth by which a disc is in front."),
            ("kernels.reconstruction.patch_match:REACH", "Half the side of a patch [pixel]."),
            ("kernels.reconstruction.patch_match:SPREAD", "Distance at which a sample counts 1/e [pixel]."),
            ("kernels.reconstruction.patch_match:CONTRAST", "Difference at which a sample counts 1/e."),
            ("kernels.reconstruction.patch_match:LEAST_VARIANCE", "Variance of a patch that says something."),
            ("kernels.reconstruction.patch_match:LEAST_FACING", "Cosine at which a view sees a plane."),
            ("kernels.reconstruction.patch_match:FARTHEST", "Most pixels of a miss that count."),
            ("kernels.reconstruction.patch_match:PER_PIXEL", "Cost of a miss of a pixel."),
        )
    ),
    *(
        Constant(f"beam_warp.reconstruction.rig:{name}", ALL, does, EXACT_RIGS)
        for name, does in (
            ("CERTAIN", "Turns of a rig that are made [standard error]."),
            ("CERTAIN_BESIDE", "Other corrections that are made beside turns [standard error]."),
            ("LEAST_DISTORTION", "Distortion of lenses that is told [pixel]."),
            ("CERTAIN_ALONE", "Those of one camera alone [standard error]."),
            ("MOST_BEHIND", "How much worse a camera that is left out is met [dB]."),
            ("ALIKE", "Quality of a photograph that is not left out [dB]."),
            ("OVERSTEP", "Steps over what photographs say."),
            ("SETTLED", "Steps that end the rounds [standard error]."),
            ("FAR", "Step that is taken at a coarser level first [pixel of the level]."),
            ("WORST_ERROR", "Standard error from which silhouettes are asked [pixel]."),
            ("POOR", "Quality below which silhouettes are asked [dB]."),
            ("UNMET", "Quality below which photographs are not of one subject [dB]."),
            ("UNEXPLAINED", "Part of a photograph's colours that others explain, below which they are not either."),
        )
    ),
    *(
        Constant(f"beam_warp.reconstruction.labels:{name}", "walker, runner, robot, balls", does, EXACT_RIGS)
        for name, does in (
            ("ALIKE", "Explained part from which on another camera may have taken a photograph."),
            ("FAR_BETTER", "How much less that leaves unexplained."),
            ("LEAST_CONTRAST", "Contrast of colours that tell."),
        )
    ),
    *(
        Constant(f"beam_warp.reconstruction.alignment:{name}", ALL, does, EXACT_RIGS)
        for name, does in (
            ("FIELD", "Side of the fields whose scores are told apart [pixel]."),
            ("OUTLIER", "Differences beyond it count by their sign [robust standard deviation]."),
            ("SEEN", "Coverage of a pixel that has a depth of its own."),
            ("MODEL_ERROR", "Standard errors over what the scatter of fields says."),
        )
    ),
    *(
        Constant(f"beam_warp.reconstruction.masks:{name}", ALL, does, EXACT_MASKS)
        for name, does in (
            ("LEAST_RING", "Width from which a ring without light is no darkness of the subject [pixel]."),
            ("FADING", "Distance from the outline to a ring that colour fades to [pixel]."),
            ("SHARP", "Distance from the outline to a ring where colour ends at once [pixel]."),
            ("RING_ERROR", "Standard error of an offset that is read from a ring [pixel]."),
            ("LEAST_MOVE", "Offset from which a mask without a ring is moved [pixel]."),
            ("MOST_GAUSSIANS", "Gaussians of a fit that shows offsets."),
            ("VISITS", "How often it looks at each view."),
            ("ROUNDS", "Most fits."),
            ("GAIN", "Offsets over what a fit shows of them."),
            ("SETTLED", "Motion of the masks at which fits end [pixel]."),
        )
    ),
    *(
        Constant(f"beam_warp.materials.light_turn:{name}", ALL, does, NO_SCORE)
        for name, does in (
            ("TURN_NEIGHBORS", "Neighbours whose base colours are compared."),
            ("REACH", "Turns beside the best that the parabola goes through."),
            ("SYSTEMATIC", "Error of a turn that the whole surface shares [degree]."),
            ("LEAST_TURN", "Least turn that is undone [degree]."),
            ("LARGEST_TURN", "Largest turn that is undone [degree]."),
            ("CERTAIN", "Standard errors from which on a turn is undone."),
            ("LEAST_EXPLAINED", "Differences that other light explains, from which on a light is another place's."),
            ("LEAST_MISSING", "Size of that other light."),
            ("MOST_ALIKE", "Part of normals that places may tell."),
        )
    ),
    *(
        Constant(f"beam_warp.materials.agreement:{name}", BOTH, does, NO_SCORE)
        for name, does in (
            ("LEAST_OVERLAP", "Coverage in common below which cameras do not fit."),
            ("GOOD_OVERLAP", "Coverage in common above which they do."),
            ("CLEARLY_MORE", "Gain that proposes other axes."),
        )
    ),
    *(
        Constant(f"beam_warp.raster.resolution:{name}", chosen_on, does, FINE_PIXELS)
        for name, chosen_on, does in (
            ("WIDEST_PIXEL", "ball, figure", "Width of a reduced pixel."),
            ("SMALL_SPLATS", JUDGED, "Percentile of scales that decides it."),
        )
    ),
    *(
        Constant(place, chosen_on, does, IMAGE_PATH)
        for place, chosen_on, does in (
            ("beam_warp.materials.images:ImagePathOptions.passes", BOTH, "Passes of baking."),
            ("beam_warp.materials.images:ImagePathOptions.ridge", BOTH, "Pull of baking towards the prior."),
            ("beam_warp.materials.images:ImagePathOptions.temporal", BOTH, "Pull towards the frame before."),
            ("beam_warp.materials.bake:BakeOptions.tolerance", JUDGED, "Gradient at which baking ends."),
            ("beam_warp.materials.bake:LEARNING_RATE", BOTH, "Step of baking by Adam."),
            ("beam_warp.kernels.trace.joint_bilateral:NORMAL_POWER", BOTH, "Denoiser: fall with normals."),
            ("beam_warp.kernels.trace.joint_bilateral:PLANE_PIXELS", BOTH, "Denoiser: fall with depth."),
            ("beam_warp.kernels.trace.joint_bilateral:VALUE_ERRORS", BOTH, "Denoiser: fall with values."),
            ("beam_warp.kernels.trace.joint_bilateral:FIREFLY", BOTH, "Denoiser: brightness that is cut."),
        )
    ),
)

RELIGHTING = (
    Constant(DEFERRED + "environment_shadows", BOTH, "Shadow maps of the environment.", more=2.0),
    Constant(DEFERRED + "bounces", BOTH, "How often light goes from surface to surface."),
    Constant(DEFERRED + "environment_map_size", BOTH, "Side of those of its regions [texel]."),
    Constant("beam_warp.render.arriving:CLUSTER_COUNT", BOTH, "Clusters that light bounces between."),
    Constant("beam_warp.render.arriving:REGION_TAPS", BOTH, "Taps that search and filter an environment's shadows."),
    Constant("beam_warp.render.shadow_maps:ROOM", JUDGED, "What a map shows, in radii of the subject."),
    Constant("beam_warp.render.shadow_maps:THICKEST", BOTH, "Largest thickness of a layer, likewise."),
    Constant("beam_warp.render.shadow_maps:LARGEST_KERNEL", JUDGED, "Largest radius of a filter, of the map's side."),
    Constant(SHADOWS + "STEEPEST " + SHADOWS + "EDGE_ON", BOTH, "Slopes from which on shadows fade, and end."),
    Constant(SHADOWS + "CURVATURE_TEXELS", BOTH, "Bias for what is curved [texel]."),
    Constant(SHADOWS + "SMOOTH_KERNEL", JUDGED, "Radius below which taps are bilinear [texel]."),
    Constant(
        "beam_warp.light.regions:WIDEST", JUDGED, "Largest half angle of a region's disc [rad].", most=math.pi / 2.1
    ),
    Constant(SOURCES + "LEAST_SHARE", JUDGED, "Least part of an environment's power of a small source.", most=1.0),
    Constant(SOURCES + "WIDEST", JUDGED, "Largest half angle of a small source [rad]."),
    Constant(SOURCES + "MOST_OF_IT", JUDGED, "Part of its power that a narrower disc must hold.", most=1.0),
    Constant(DEFERRED + "light_map_size", BOTH, "Side of lamps' and small sources' shadow maps [texel]."),
    Constant("beam_warp.render.arriving:LIGHT_TAPS", BOTH, "Taps that search and filter those shadows."),
    Constant("beam_warp.render.shadow_maps:WIDEST", JUDGED, "Half angle of a single view [degree].", LAMPS),
    Constant("beam_warp.render.shadow_maps:NEARBY", JUDGED, "Radii within which props cast shadows.", "there are none"),
)

PATH_TRACING = (
    Constant("beam_warp.render.path:PathOptions.bounces", BOTH, "How often light goes from surface to surface."),
    Constant(VERTICES + "LIFT", BOTH, "Lift of rays, in reaches of the layer's Gaussians."),
    Constant(VERTICES + "LEANING_COSINE", BOTH, "Cosine below which a normal is an outline's.", most=1.0),
    Constant(VERTICES + "GAP_IN_SIZES", BOTH, "Gap, in scales, behind which another surface begins."),
    Constant(
        "beam_warp.render.path:FEWEST_PASSES", JUDGED, "Passes before noise is believed.", "no target error is set"
    ),
)

GROUPS = {
    "reconstruction": RECONSTRUCTION,
    "tracking": TRACKING,
    "meshing": MESHING,
    "materials": MATERIALS,
    "relighting": RELIGHTING,
    "path tracing": PATH_TRACING,
}
"""Constants by what they belong to."""

UNTUNED = {
    "stated by a paper, or following from physics or arithmetic": """
        beam_warp.reconstruction.sampling_limits: FILTER_VARIANCE NEAR IMAGE_MARGIN
        beam_warp.reconstruction.initial: HEXAGONAL NEIGHBORS FALLBACK_ROUNDS
        beam_warp.reconstruction.joints.selection: FAINTEST
        beam_warp.kernels.reconstruction.display_encoding: KNEE
        beam_warp.kernels.reconstruction.visual_hull: BLOCK BLOCK_POINTS BLOCK_CELLS PIXEL_MARGIN NEAR
        beam_warp.kernels.reconstruction.seen_colors: ROUNDS
        beam_warp.materials.base_color: UNKNOWN
        beam_warp.materials.evidence: RADII
        beam_warp.materials.roughness: GRID PRECISIONS STEPS SPREADS PARTS_OF_SCATTER
        beam_warp.materials.roughness_profile: CANDIDATES
        beam_warp.materials.exposure: EXPOSURE_FACTORS
        beam_warp.materials.light: FEW_VALUES EIGHT_BIT CUT_PART STEP_SLACK DARKEST
        beam_warp.materials.light_turn: TURNS
        beam_warp.materials.pilot: RATE SHARE
        beam_warp.reconstruction.masks: FEWEST_VIEWS SIDE SAMPLES WINDOW
        beam_warp.reconstruction.rig: MOST_LEFT_OUT
        beam_warp.reconstruction.photometry: CHANCE COSINES EXPOSURE BALANCE
        beam_warp.materials.light_fits: CHANCE
        beam_warp.materials.agreement: CUT_PART UNITS
        beam_warp.kernels.materials.pixel_surfaces: LEAST_FACING
        ImagePathOptions: occlusion_samples light_samples offset steps
        beam_warp.kernels.render.cluster_bounces: MEAN_COSINE INVERSE_PI PARTS
        beam_warp.kernels.render.gaussian_light: TAU
        beam_warp.kernels.render.shadow_maps: ROUNDING
        beam_warp.render.shadow_maps: FACE_ANGLE FAR NEAR
        beam_warp.render.pictures: BLACK
        beam_warp.render.sheet: WHITE_IRRADIANCE""",
    "what a user asks for, or the quality that a user pays for": """
        FitOptions: gaussian_count seed
        ReconstructOptions: segment_length seam_frames
        MaterialOptions: seed
        ImagePathOptions: seed
        BakeOptions: seed steps
        DeferredOptions: samples
        PathOptions: samples seed""",
    "not used, or another option's": """
        FitOptions: raster.near temporal
        beam_warp.reconstruction.fit: OF_FEW_STEPS
        TrackOptions: joints.weights.normal
        TrackOptions: refinement.weights refinement.raster refinement.sh_degree refinement.seed
        TrackOptions: refinement.gaussian_count refinement.color_iterations refinement.refine_every refinement.dropout
        TrackOptions: refinement.reset_below refinement.total_variation refinement.reflect_until
        TrackOptions: refinement.rates.gloss
        TrackOptions: refinement.refine_until refinement.split_fraction refinement.hidden_share refinement.dead_opacity
        BakeOptions: passes ridge temporal low high""",
    "limits of memory, time and floating point, and sizes of blocks": """
        beam_warp.reconstruction.fit: NO_PSNR PROGRESS_EVERY
        beam_warp.reconstruction.reflections: ROWS_AT_ONCE
        beam_warp.reconstruction.frames.reader: LOADING_THREADS
        beam_warp.reconstruction.frames.store: ID_BITS
        beam_warp.reconstruction.gains: LARGEST_SIDE MOST_POINTS DARKEST ROUNDS SETTLED
        beam_warp.reconstruction.hull: MIN_RESOLUTION MAX_RESOLUTION SEARCH_BLOCKS SEARCH_ROUNDS ENOUGH SEARCH_SIDE
        beam_warp.reconstruction.hull: DISTANCE_LIMIT
        beam_warp.reconstruction.rig: FEWEST_CAMERAS FEWER_POINTS FEWEST_GAUSSIANS MOST_GAUSSIANS
        beam_warp.reconstruction.rig: SHORTEST_SIDE
        beam_warp.reconstruction.labels: MOST_POINTS FEWEST_POINTS SOLID
        beam_warp.reconstruction.alignment: ENCODED_KNEE NUMBERS
        beam_warp.reconstruction.stereo: LEVELS SMALLEST_SIDE LEAST_PIXELS
        beam_warp.reconstruction.unmasked: PIXELS
        beam_warp.kernels.reconstruction.patch_match: STEP SIDE SAMPLES
        beam_warp.reconstruction.photometry: FEWEST_CAMERAS FEWEST_POINTS FIRST_POINTS MOST_POINTS LEAST_VIEWS
        beam_warp.reconstruction.photometry: ROUNDS SETTLED
        beam_warp.reconstruction.photometry: LEAST_VARIANCE
        beam_warp.reconstruction.parameters: SMALLEST_SCALE LOGIT_LIMIT DEAD_LOGIT
        beam_warp.reconstruction.targets: CROP_STEP
        beam_warp.reconstruction.temporal: SMALLEST_SPACING
        beam_warp.kernels.reconstruction.silhouettes: MIN_LINES
        beam_warp.kernels.reconstruction.skinning: RUN MESSAGE MOST_JOINTS
        beam_warp.materials.agreement: MATCH_VIEWS MATCH_SIDE SEARCH_VIEWS SEARCH_SIDE SEARCH_GAUSSIANS SOLID SAME
        beam_warp.materials.bake: MOST_COLUMNS GROUP_SPLATS GROUP_PIXELS LEAST_EVIDENCE
        beam_warp.materials.bounded_solve: CHECK_EVERY
        beam_warp.materials.blended_color: COLUMNS
        beam_warp.materials.base_color: PAIRED PAIR_GROUPS MISSING
        beam_warp.materials.changes: LEAST_ERROR
        beam_warp.materials.evidence: SURFACE_CHANNELS PIXELS_AT_ONCE CUTTING_THREADS MARGIN
        beam_warp.materials.roughness_profile: REFLECTIONS_AT_ONCE
        beam_warp.materials.light_rays: FEWEST_FIRST_RAYS
        beam_warp.materials.exposure: ASKED
        beam_warp.materials.images: UNLIT_PART WHOLE_ALPHA CROP_MARGIN UNSEEN_EVIDENCE
        beam_warp.materials.light: ASKED MOST_VIEWS NEAR
        beam_warp.materials.light_fits: LIGHT_ROWS LIGHT_COLUMNS EVEN LEAST_LIGHT BLOCKS LEAST_IN_BLOCK LEAST_POINTS
        beam_warp.materials.light_fits: LEAST_VIEWS VIEW_THREADS
        beam_warp.materials.light_turn: SPLIT LEAST_COLOR LEAST_LIGHT FLAT ROUNDS SMALLEST_DIFFERENCE PULL
        beam_warp.materials.residues: LEAST_ALPHA FEWEST_LIGHT_SAMPLES
        beam_warp.materials.roughness: MOST_ASKED MOST_COMPARED ANGLE_STEP TINY
        beam_warp.materials.roughness_source: MAX_TEXELS
        beam_warp.kernels.materials.bounded_solve: LANES
        beam_warp.kernels.materials.view_evidence: PIXEL_CHANNELS
        beam_warp.kernels.materials.roughness_profile: PARTS
        beam_warp.render.path: PASS_SAMPLES NOISE_BLOCK WARP_TILE DARKEST CHECKPOINT_SECONDS
        beam_warp.render.shadow_maps: GROUP_SPLATS
        beam_warp.kernels.render.gaussian_light: POINT_CHUNK
        beam_warp.kernels.render.deferred_pixels: SHADE_CHUNK
        beam_warp.kernels.render.path_tracing: FIRST_PAIRS VERTEX_PAIRS""",
    "how results are scored and shown": """
        beam_warp.reconstruction.drift: NEAR LEAST_OPACITY CARRIERS
        beam_warp.reconstruction.preview: AMPLIFICATION MOST_ROWS FUSED_ROWS FEWEST_ROWS
        beam_warp.render.channels: MOST_GAUSSIANS TEXT_COLOR TEXT_SIZE LINE_HEIGHT MARGIN""",
    "numbers of cases and of columns": """
        beam_warp.kernels.reconstruction.visual_hull: OUTSIDE SURFACE INSIDE
        beam_warp.kernels.reconstruction.patch_match: NEITHER WORST
        beam_warp.kernels.materials.residues: ALBEDO_SCALING FRESNEL_HV
        beam_warp.materials.light_rays: DIFFUSE_WEIGHTS
        beam_warp.kernels.materials.bounded_solve: WALK FREE SHIFT
        beam_warp.kernels.render.gaussian_light: ROUGHNESS OCCLUSION NORMAL ARRIVING OPENNESS""",
}
"""All other numbers of the packages, by why they are what they are: a module or a class of options, and its names."""


def untuned_places() -> set[str]:
    """Return the places of `UNTUNED`: ``module:NAME`` or ``Options.path``."""
    found = set()
    for text in UNTUNED.values():
        for line in text.split("\n"):
            holder, _, names = line.strip().partition(": ")
            found |= {f"{holder}{':' if '.' in holder else '.'}{name}" for name in names.split()}
    return found
