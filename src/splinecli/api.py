"""Functions for arrays, for example in a notebook: `splinecli.estimate_normals` and its
companions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import ArrayLike, NDArray

    from splinecli.estimate.inference import NormalEstimate
    from splinecli.materials.maps import MaterialMaps

# Everything else is imported inside the functions, because PyTorch takes a second or more to load.


def estimate_normals(  # noqa: PLR0913 - keyword arguments suit a notebook
    images: ArrayLike | Sequence[NDArray[Any]],
    light_directions: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    *,
    light_intensities: ArrayLike | None = None,
    first_light: str | float | None = None,
    pixel_size: float | None = None,
    camera_matrix: ArrayLike | None = None,
    method: str = "spline-net",
    as_stored: bool = False,
    white_level: float | None = None,
    weights: str | None = None,
    rotations: int | None = None,
    distil: bool | None = None,
    batch_size: int | None = None,
    device: Literal["auto", "cpu", "cuda"] = "auto",
    precision: Literal["auto", "float32", "bfloat16"] = "auto",
    progress: Callable[[int], object] | None = None,
) -> NormalEstimate:
    """Estimate surface normals from images of one object under different lights.

    The images are prepared and checked against the lights, and the normals are estimated, exactly
    as in `splinecli infer`. Warnings that an input is probably wrong, such as light directions in
    another frame, are also issued with Python's `warnings` module.

    The first call limits PyTorch's threads to the cores that the process may use. If other
    processes keep the machine busy, also set the environment variable OMP_WAIT_POLICY to passive
    before PyTorch is imported.

    Args:
        images: (F, H, W) gray or (F, H, W, 3) RGB, or a list of F such images, linear, row 0 at the
            top. uint8 and uint16 values are scaled by their full range; floating-point values are
            not scaled.
        light_directions: (F, 3), from the object towards the lights, of any length; x right, y up,
            z to the camera. None estimates them from the images, as `infer --lights estimate` does.
            See capture.light_errors_deg.
        mask: (H, W), True at the pixels of the object. In a mask of numbers, as in a mask file,
            these are the values above half of the maximum. None uses all pixels.
        light_intensities: (F,) or (F, 3) RGB. If they are None, they are estimated if the images
            show that they differ.
        first_light: if light_directions is None, the side of the image that the first light comes
            from, such as "left" or "upper-left", or its azimuth in degrees, counter-clockwise from
            the right. It is required if the images do not show the outline of the object.
        pixel_size: the width of a pixel on the object, for near lamps. In this case,
            light_directions are positions of the lamps in the same unit, relative to the centre of
            the image on the object's mean plane.
        camera_matrix: (3, 3) in pixels, as in OpenCV, for a camera that is close relative to the
            object's width. Light directions are relative to its axis. None assumes an orthographic
            camera.
        method: a name of `splinecli infer --method`, such as "spline-net" or "ls". See
            splinecli.estimate.methods.METHODS.
        as_stored: use the image values unchanged. By default, lens blur is removed, saturated
            observations are restored and unknown light intensities are estimated.
        white_level: observations at or above this value are saturated, in the unit of the images.
            None detects it in integer images, and assumes no saturation in floating-point images.
        weights: name or file of a network's weights. None uses the method's default.
        rotations: number of rotations of the lights over which a network averages its normals. None
            uses the method's default.
        distil: whether to approximate the method by a small network, trained on a sample of the
            pixels. False applies the method to every pixel; None distils from 100,000 pixels.
        batch_size: pixels per batch. None uses the method's default.
        device: where to compute; "auto" is a CUDA GPU if there is one.
        precision: number format of a network; "auto" is bfloat16 if the device computes
            faster in it.
        progress: called with the number of pixels just finished, about every 1,000 pixels for
            networks.

    Returns:
        A record with normal_map, (H, W, 3) float32, x right, y up, z to the camera, unit in the
        mask and zero outside; confidence_map, (H, W) float32, the probability that the error is at
        most 5 degrees, or None if the method does not estimate it (only spline-net and
        spline-net-pixelwise do, with the shipped weights or others that have an error head); and
        capture, with the observations and with warnings that you should read.

    Raises:
        splinecli.errors.UsageError: a shape, a type or an option is invalid.
        splinecli.errors.InputError: a value is negative or not finite, the lights do not determine
            normals (fewer than three, below the horizon, all in one plane), or the mask is empty.
        splinecli.errors.ModelError: the weights cannot be used.

    Examples:
        A matte plane under four lights:

        >>> import numpy as np
        >>> import splinecli
        >>> lights = np.array([[0, 0, 1], [0.6, 0, 0.8], [0, 0.6, 0.8], [-0.6, 0, 0.8]])
        >>> images = np.ones((4, 8, 8)) * (lights @ (0.36, 0.48, 0.8))[:, None, None]
        >>> estimate = splinecli.estimate_normals(images, lights, method="ls")
        >>> print(estimate.normal_map[0, 0].round(2))
        [0.36 0.48 0.8 ]

    References:
        Zheng et al., SPLINE-Net: sparse photometric stereo through lighting interpolation and
        normal estimation networks, ICCV 2019.
    """
    from warnings import warn

    from splinecli.capture.arrays import open_arrays
    from splinecli.errors import UsageError
    from splinecli.estimate.methods import MethodOptions, check_method, make_estimator
    from splinecli.pipeline.infer import estimate_capture
    from splinecli.recipe.steps import begin, follow
    from splinecli.recipe.work import RecipeOptions
    from splinecli.records.capture_warnings import LIGHTS_MENDED

    check_method(method)
    if first_light is not None and light_directions is not None:
        raise UsageError(
            "first_light and light_directions cannot be used together", hint="Leave one out"
        )
    source = open_arrays(
        images,
        light_directions,
        mask,
        light_intensities=light_intensities,
        pixel_size=pixel_size,
        camera_matrix=camera_matrix,
        white_level=white_level,
    )
    recipe = RecipeOptions(
        as_stored=as_stored,
        mends=not as_stored,
        finds_lights=light_directions is None,
        first_light=None if first_light is None else str(first_light),
    )
    work = follow(begin(source, options=recipe), until="judgement")
    options = MethodOptions(weights, rotations, batch_size, device, precision)
    estimator = make_estimator(method, options)
    estimate, _, _ = estimate_capture(work, lambda: estimator, distil=distil, progress=progress)
    for warning in estimate.capture.warnings:
        if warning.is_error or warning.kind is LIGHTS_MENDED:
            warn(str(warning), stacklevel=2)
    return estimate


def estimate_material(estimate: NormalEstimate, colours: ArrayLike | None = None) -> MaterialMaps:
    """Estimate base colour, roughness, metalness and specular reflection of each pixel.

    The result is the same as for `infer --maps material`.

    Args:
        estimate: the result of estimate_normals.
        colours: (F, H, W, 3) linear RGB, the images divided by the light intensities. None, for
            gray images, gives a gray base colour.

    Returns:
        A record of arrays for the P pixels of the mask, row by row: base_colour (P, 3), and
        roughness, metalness, specular and confidence (P,). `is_gray` is True if the base colour
        contains only brightness.

    Raises:
        splinecli.errors.InputError: there are fewer than four lights, or a colour is not finite.
        splinecli.errors.UsageError: the colours have the wrong shape.

    Examples:
        An orange matte plane under four lights:

        >>> import numpy as np
        >>> import splinecli
        >>> lights = np.array([[0, 0, 1], [0.6, 0, 0.8], [0, 0.6, 0.8], [-0.6, 0, 0.8]])
        >>> colours = np.ones((4, 8, 8, 1)) * lights[:, None, None, 2:] * (0.8, 0.4, 0.16)
        >>> estimate = splinecli.estimate_normals(colours, lights, method="ls")
        >>> base = splinecli.estimate_material(estimate, colours).base_colour
        >>> print((base[0] / base[0].max()).round(1))
        [1.  0.5 0.2]
    """
    import numpy as np

    from splinecli.errors import InputError, UsageError
    from splinecli.results.material import material_of

    capture = estimate.capture
    if colours is None:
        return material_of(estimate)
    stack, expected = np.asarray(colours), (capture.n_lights, *capture.mask.shape, 3)
    if stack.shape != expected or stack.dtype.kind not in "uif":
        problem = (
            f"found colours of shape {stack.shape} and type {stack.dtype}, expected numbers of"
            f" shape {expected}"
        )
        raise UsageError(problem, hint="Leave colours out for gray images")
    if not np.isfinite(stack[:, capture.mask]).all():
        raise InputError("some colours are not finite", hint="Leave their pixels out of the mask")
    images = (image[capture.mask].astype(np.float32) for image in stack)
    means = capture.observations.T
    # The observations may have another scale, and contain restored values.
    scaled = (
        image * (mean / np.maximum(image.mean(axis=1), 1e-12))[:, None]
        for image, mean in zip(images, means, strict=True)
    )
    return material_of(estimate, scaled)


def integrate_normals(
    normal_map: NDArray[np.floating],
    mask: NDArray[np.bool_] | None = None,
    camera_matrix: NDArray[np.floating] | None = None,
    *,
    discontinuity: float = 2.0,
) -> NDArray[np.float64]:
    """Integrate a normal map (H, W, 3) into a height or depth map (H, W) float64.

    The result is NaN outside the mask.

    For an orthographic camera, the result is the height towards the camera in pixels. With a camera
    matrix, it is the positive depth along the viewing axis, of unknown scale.
    `splinecli.surface.integration` has further options.

    Args:
        normal_map: unit normals in the mask, row 0 at the top; x right, y up, z to the camera.
        mask: (H, W), True at the pixels to integrate. None uses all finite, non-zero normals.
        camera_matrix: (3, 3) in pixels, as in OpenCV. None assumes an orthographic camera.
        discontinuity: sensitivity to discontinuities. 0 is least squares, which gives a continuous
            surface.

    Raises:
        splinecli.errors.UsageError: the shapes or types of the arrays do not match, or an option is
        out of range.
        splinecli.errors.InputError: the mask is empty, a normal in the mask is not a unit vector,
            or the camera matrix is not valid.

    Examples:
        A plane that rises by 0.75 pixels per column:

        >>> import numpy as np
        >>> import splinecli
        >>> heights = splinecli.integrate_normals(np.full((4, 5, 3), (-0.6, 0.0, 0.8)))
        >>> print(np.diff(heights[0]).round(2))
        [0.75 0.75 0.75 0.75]

    References:
        Cao, Santo, Shi, Okura and Matsushita, Bilateral normal integration, ECCV 2022.
    """
    from splinecli.surface.integration import integrate_normals

    return integrate_normals(normal_map, mask, camera_matrix, discontinuity=discontinuity)
