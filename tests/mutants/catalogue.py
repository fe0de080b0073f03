"""Ways to break the rasterizer, each with the tests that must notice.

A mutant is a defect that one could really write; where two hard cases fall to the same one, it names both.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Mutant:
    """One edit of one file, named after its defect, and the tests (paths below tests/) that must fail because of it."""

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]


PROJECT = "ahoy_core/splat/_project.py"
PROJECT_BACKWARD = "ahoy_core/splat/_project_backward.py"
BINNING = "ahoy_core/splat/_binning.py"
BLEND = "ahoy_core/splat/_blend.py"
BLEND_BACKWARD = "ahoy_core/splat/_blend_backward.py"
PLAN = "ahoy_core/splat/_plan.py"

DEPTH = "numerics/test_depth_and_frustum.py::test_"
SHAPE = "numerics/test_shape.py::test_"
LAYERS = "numerics/test_opacity_and_layers.py::test_"
BROKEN = "numerics/test_broken_rows.py::test_"
SIZES = "numerics/test_sizes.py::test_"

POSITION = (
    Mutant(
        "near plane included",
        PROJECT,
        "(z > camera[cam.NEAR])",
        "(z >= camera[cam.NEAR])",
        (DEPTH + "gaussians_behind_and_at_the_near_plane_are_absent",),
    ),
    Mutant(
        "whole Gaussian must be in front of the near plane",
        PROJECT,
        "(z > camera[cam.NEAR])",
        "(z - 0.1 > camera[cam.NEAR])",
        (DEPTH + "gaussians_that_straddle_the_near_plane_match_the_oracle",),
    ),
    Mutant(
        "Jacobian not clamped off the frustum",
        PROJECT,
        "u = minimum(maximum(x * rz, camera[cam.X_MIN]), camera[cam.X_MAX])",
        "u = x * rz",
        (
            DEPTH + "gaussians_far_off_the_frustum_match_the_oracle",
            DEPTH + "a_wide_gaussian_beside_the_frustum_shows_with_the_clamped_jacobian",
        ),
    ),
    Mutant(
        "depth sorted in float32 NDC",
        PROJECT,
        "order_keys[row] = out[4 * LANES + lane] if visible else 0.0",
        "order_keys[row] = math.floor((1.0 - 0.01 / out[4 * LANES + lane]) * 2.0**24) if visible else 0.0",
        (DEPTH + "layers_one_part_in_a_million_apart_are_sorted_rightly",),
    ),
    Mutant(
        "unstable sort at ties",
        PROJECT,
        "order_keys[row] = out[4 * LANES + lane] if visible else 0.0",
        "order_keys[row] = out[4 * LANES + lane] + 1e-12 * ((row * 37) % 101) if visible else 0.0",
        (
            DEPTH + "equal_depths_blend_in_the_order_of_the_input",
            DEPTH + "moving_other_gaussians_in_the_input_does_not_change_how_ties_blend",
        ),
    ),
    Mutant(
        "camera kept in float32",
        "ahoy_core/splat/_camera.py",
        "return packed",
        "return packed.astype(np.float32).astype(np.float64)",
        (DEPTH + "a_world_shifted_by_a_million_metres_in_float64_looks_the_same",),
    ),
    Mutant(
        "world -> camera rounded as float32 rounds at a million metres",
        PROJECT,
        "camera[6] * x + camera[7] * y + camera[8] * z + camera[11],",
        "(camera[6] * x + camera[7] * y + camera[8] * z + 3e14 - 3e14) + camera[11],",
        (DEPTH + "a_world_shifted_by_a_million_metres_in_float32_matches_the_oracle_fed_with_the_same_rounding",),
    ),
    Mutant(
        "pose gradient without the translation's share of depth",
        PROJECT_BACKWARD,
        "add_pose(pose, 11, seen, vz)",
        "add_pose(pose, 11, seen, 0.99 * vz)",
        (DEPTH + "a_camera_pose_far_from_the_origin_gets_its_gradient",),
    ),
)

SHAPES = (
    Mutant(
        "zero scale refused like a negative one",
        PROJECT,
        "scales[i + lane, 2]) < 0.0:",
        "scales[i + lane, 2]) <= 0.0:",
        (
            SHAPE + "scales_at_the_extremes_match_the_oracle",
            SHAPE + "flat_gaussians_match_the_oracle",
            SHAPE + "no_low_pass_at_all_drops_what_has_no_area",
        ),
    ),
    Mutant(
        "invertibility tested before the low-pass",
        PROJECT,
        "(det > 0.0) & (det < math.inf)",
        "(sharp > 0.0) & (sharp < math.inf)",
        (
            SHAPE + "scales_at_the_extremes_match_the_oracle",
            SHAPE + "flat_gaussians_match_the_oracle",
            SHAPE + "singular_covariances_match_the_oracle",
        ),
    ),
    Mutant(
        "compensation with a floor",
        PROJECT,
        "rho = sqrt(sharp / det) if antialiased",
        "rho = sqrt(maximum(sharp / det, 1e-2)) if antialiased",
        (SHAPE + "zero_determinant_with_antialiasing_is_invisible_and_harmless",),
    ),
    Mutant(
        "determinant as a difference of products, one of them off by a float32 step",
        PROJECT,
        "p * p + q * q + r * r\n",
        "p * p + q * q + r * r + 6e-8 * (u0 * u0 + u1 * u1) * (v0 * v0 + v1 * v1)\n",
        (
            SHAPE + "needles_a_hundred_million_times_longer_than_wide_match_the_oracle",
            SHAPE + "needles_in_float64_kernels_match_the_oracle_closely",
        ),
    ),
    Mutant(
        "short quaternions taken for zero",
        PROJECT,
        "usable = square > 0.0",
        "usable = square > 1e-12",
        (SHAPE + "quaternions_of_any_length_match_the_oracle",),
    ),
    Mutant(
        "zero quaternion divides by zero",
        PROJECT,
        "usable = square > 0.0",
        "usable = square >= 0.0",
        (SHAPE + "a_zero_quaternion_is_the_identity_without_gradient",),
    ),
)

BLENDING = (
    Mutant(
        "alpha clamped at 0.99 as in the first 3DGS code",
        "ahoy_core/splat/constants.py",
        "ALPHA_MAX: Final = 0.999",
        "ALPHA_MAX: Final = 0.99",
        (
            LAYERS + "opacity_at_its_ends_matches_the_oracle",
            LAYERS + "a_wholly_opaque_scene_matches_the_oracle",
        ),
    ),
    Mutant(
        "alpha clamped in the forward pass only",
        BLEND_BACKWARD,
        "select(raw <= alpha_max,",
        "select(raw <= one + one,",
        (LAYERS + "alpha_above_the_clamp_gives_the_same_image_and_no_gradient",),
    ),
    Mutant(
        "reach of three sigma whatever the opacity",
        BINNING,
        "limit = maximum(load(scratch, 5 * LANES) - log2_cutoff, 0.0) *",
        "limit = minimum(maximum(load(scratch, 5 * LANES) - log2_cutoff, 0.0), 6.49) *",
        (LAYERS + "an_opaque_gaussian_reaches_as_far_as_the_cutoff_says",),
    ),
    Mutant(
        "rank of the last Gaussian kept in eight bits",
        BLEND,
        "rank = splat(np.int32(k - start))",
        "rank = splat(np.int32(min(k - start, 255)))",
        (
            LAYERS + "a_thousand_faint_layers_match_the_oracle",
            LAYERS + "five_thousand_identical_gaussians_match_the_oracle",
            SIZES + "thousands_of_screen_filling_gaussians_match_the_oracle",
        ),
    ),
    Mutant(
        "Gaussian that crosses the transmittance stop is blended",
        BLEND,
        "weight = select(going, alpha * before, zero)",
        "weight = alpha * before",
        (LAYERS + "transmittance_stop_leaves_out_what_crosses_it_and_all_behind",),
    ),
)

ROWS = (
    Mutant(
        "broken rows counted and blended all the same",
        PROJECT,
        "scratch[TOTAL * LANES + lane] = math.nan",
        "scratch[TOTAL * LANES + lane] = 0.0",
        (
            BROKEN + "a_broken_row_is_isolated",
            BROKEN + "a_broken_coefficient_is_isolated",
        ),
    ),
    Mutant(
        "broken rows not looked for",
        PROJECT,
        "if not abs(total) < math.inf:",
        "if not abs(total) < math.inf and i < 0:",
        (
            BROKEN + "one_broken_coordinate_is_enough",
            BROKEN + "a_broken_covariance_is_isolated",
            BROKEN + "a_broken_row_is_isolated_in_depth_images",
            BROKEN + "a_scene_of_broken_rows_only_is_background",
        ),
    ),
)

IMAGES = (
    Mutant(
        "background forgotten",
        BLEND,
        "channel_blend(behind, rest, state, block * stride + 2 * LANES)",
        "channel_blend(behind, rest - rest, state, block * stride + 2 * LANES)",
        (
            SIZES + "empty_input_is_background_with_gradients_of_the_right_shape",
            SIZES + "nothing_in_view_is_background_with_zero_gradients",
        ),
    ),
    Mutant(
        "blocks across the right border skipped",
        BLEND,
        "if columns > 0 and rows > 0:",
        "if columns > 3 and rows > 0:",
        (SIZES + "any_image_size_matches_the_oracle",),
    ),
    Mutant(
        "tiles of 32 filled to a quarter",
        BINNING,
        "groups = max(1, (tile_size // 4) ** 2 // 16)",
        "groups = 1",
        (SIZES + "tiles_of_8_16_and_32_give_the_same_bits",),
    ),
    Mutant(
        "memory budget not enforced",
        PLAN,
        "if total > allowed:",
        "if total > allowed * 1000000:",
        (SIZES + "intersections_beyond_the_memory_budget_are_refused_before_they_are_held",),
    ),
    Mutant(
        "memory budget one intersection too small",
        PLAN,
        "if total > allowed:",
        "if total >= allowed:",
        (SIZES + "the_memory_budget_is_exact_and_does_not_change_the_image",),
    ),
    Mutant(
        "intersections counted in 32 bits",
        BINNING,
        "starts = np.empty(tiles + 1, np.int64)",
        "starts = np.empty(tiles + 1, np.int32)",
        (SIZES + "more_than_two_to_the_31_intersections_are_counted_rightly",),
    ),
)

MUTANTS: tuple[Mutant, ...] = POSITION + SHAPES + BLENDING + ROWS + IMAGES
