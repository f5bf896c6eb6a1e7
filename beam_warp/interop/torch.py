"""Gaussians in torch tensors, drawn and differentiated where they are: a node of torch's graph around the rasteriser.

Tensors go in without a copy, whatever the strides of their rows. What comes out are copies: the rasteriser's own images
and gradients are overwritten by its next draw, and torch keeps what it is given. All work is queued on torch's current
stream.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import warp as wp

from beam_warp.checks import require_count
from beam_warp.device.arrays import resolve_device
from beam_warp.errors import InvalidArrayError, InvalidOptionError, MissingPackageError
from beam_warp.kernels.raster.composite import CHANNEL_COUNTS
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.records import COEFFICIENT_COUNTS, GaussianArrays, RasterImages, RasterOptions
from beam_warp.raster.view_images import ViewImages, view_images
from beam_warp.world.camera import Camera

try:
    import torch  # noqa: TID251  # pyright: ignore[reportMissingImports]
    from torch.autograd.function import once_differentiable  # noqa: TID251  # pyright: ignore[reportMissingImports]
except ImportError as error:
    raise MissingPackageError(
        "torch must be installed to draw its tensors, got no such package. Run pip install 'beam-warp[interop]'."
    ) from error


class TorchImages(NamedTuple):
    """Images of all cameras in new tensors, one view after the other and row by row.

    Attributes:
        colors: Sum of the captured colour, weighted by visibility, ``(P, 3)``; None where none is drawn.
        normals: Sum of the normals of geometry, in the world and towards the camera, ``(P, 3)``, or None.
        values: Sum of the values, ``(P, K)``, or None.
        alpha: Sum of the weights, ``(P,)``.
        depth: Mean depth along the optical axis [m], ``(P,)``; 0 where nothing is seen.
        median_depth: Depth of the last splat that more than half of the light passes before [m], ``(P,)``.
        gaussian_ids: The last Gaussian that was seen, -1 for none, ``(P,)`` int32; without derivative.
    """

    colors: torch.Tensor | None
    normals: torch.Tensor | None
    values: torch.Tensor | None
    alpha: torch.Tensor
    depth: torch.Tensor
    median_depth: torch.Tensor
    gaussian_ids: torch.Tensor


@dataclass(frozen=True, eq=False)
class _Ticket:
    """Identity of a draw: the rasteriser's state belongs to the last draw's ticket."""

    cameras: tuple[Camera, ...]


class TorchRasterizer:
    """Draws some number of Gaussians in torch tensors for some cameras, again and again, with gradients.

    It owns one `Rasterizer`. Every draw may be differentiated later, in any order: where another draw came between, the
    way back draws the first one again. So a loss of several views is cheapest when all are drawn in one call. Not for
    several threads at once.

    Attributes:
        cameras: The cameras of a draw that is given no others.
        device: The torch device.
    """

    def __init__(
        self,
        gaussian_count: int,
        cameras: Sequence[Camera],
        *,
        value_count: int = 0,
        coefficient_count: int = 0,
        normals: bool = False,
        options: RasterOptions | None = None,
        device: Any = None,
    ) -> None:
        """Allocate the arrays of every draw.

        Args:
            gaussian_count: N.
            cameras: At least one, of any sizes.
            value_count: K, the number of the Gaussians' own values that are composited.
            coefficient_count: Number of spherical harmonics of the captured colour, 1, 4, 9, 16 or 25; 0 for none.
            normals: Whether the normal of the geometry is drawn.
            options: How splats are drawn.
            device: A torch device or its name; None takes the first CUDA device, or the CPU where there is none.

        Raises:
            DeviceError: There is no such device.
            InvalidOptionError: There is no camera, or a count is out of range.
        """
        require_count("gaussian_count", gaussian_count, 0)
        require_count("value_count", value_count, 0)
        choices = (0, *COEFFICIENT_COUNTS)
        if coefficient_count not in choices:
            raise InvalidOptionError(
                f"coefficient_count must be one of {choices}, got {coefficient_count!r}. Choose one of them."
            )
        self._warp_device = resolve_device(None if device is None else _device_name(device))
        self.device = torch.device(str(self._warp_device))
        self.cameras = tuple(cameras)
        self._shapes = {
            "positions": (gaussian_count, 3),
            "orientations": (gaussian_count, 4),
            "scales": (gaussian_count, 3),
            "opacities": (gaussian_count,),
            "values": (gaussian_count, value_count) if value_count else None,
            "radiance": (gaussian_count, coefficient_count, 3) if coefficient_count else None,
        }
        self._stream: Any = None
        self._drawn: _Ticket | None = None
        self._shared: dict[str, tuple[Any, list[Any]]] = {}
        with self._torch_stream():
            self._rasterizer = Rasterizer(
                gaussian_count,
                self.cameras,
                value_count=value_count,
                radiance=coefficient_count > 0,
                normals=normals,
                options=options,
                device=self._warp_device,
                checkpoints=True,
            )

    def __del__(self) -> None:
        """Wait for work queued on a stream of the caller's: Warp does not wait for those before it frees memory."""
        stream = getattr(self, "_stream", None)
        if stream is not None and stream.cuda_stream != 0:
            stream.synchronize()

    def draw(
        self,
        positions: torch.Tensor,
        orientations: torch.Tensor,
        scales: torch.Tensor,
        opacities: torch.Tensor,
        values: torch.Tensor | None = None,
        radiance: torch.Tensor | None = None,
        *,
        cameras: Sequence[Camera] | None = None,
    ) -> TorchImages:
        """Draw Gaussians; every tensor may ask for a gradient.

        Waits for the device as `Rasterizer.draw` does, to learn how much room the frame takes, and nowhere else.

        Args:
            positions: ``(N, 3)`` float32 [m].
            orientations: ``(N, 4)`` quaternions **xyzw**; normalised where they are used.
            scales: ``(N, 3)`` [m].
            opacities: ``(N,)`` in [0, 1].
            values: ``(N, K)``; None where this was made for none.
            radiance: ``(N, B, 3)`` spherical harmonics; None where this was made for none.
            cameras: Others of the same number and sizes than this was made for.

        Returns:
            New tensors. What is discrete has no derivative: which splats count, their order, the cap of alpha, the pick
            of the median.

        Raises:
            InvalidArrayError: A tensor has another shape, type or device.
            InvalidOptionError: A number of cameras or a size differs.
        """
        views = self.cameras if cameras is None else tuple(cameras)
        given = (positions, orientations, scales, opacities, values, radiance)
        tensors = [
            _compact_rows(name, tensor, shape, self.device)
            for (name, shape), tensor in zip(self._shapes.items(), given, strict=True)
        ]
        return TorchImages(*_Draw.apply(self, _Ticket(views), *tensors))

    def view_images(self) -> list[ViewImages]:
        """Return each camera's last images in the rasteriser's own memory: no copy, no gradient.

        ``torch.from_dlpack(view.alpha)`` shares it until the next draw, or the way back of another, overwrites it.
        """
        if self._stream is not None:  # whatever reads is ordered behind Warp's stream, so that goes behind torch's
            self._warp_device.stream.wait_stream(wp.stream_from_torch(self._stream))
        return view_images(self._rasterizer)

    @contextmanager
    def _torch_stream(self) -> Iterator[None]:
        """Queue Warp's work on torch's current stream, behind work that was queued here on another."""
        if not self._warp_device.is_cuda:
            yield
            return
        stream = torch.cuda.current_stream(self.device)
        if self._stream is not None and stream != self._stream:
            stream.wait_stream(self._stream)
        self._stream = stream
        with wp.ScopedStream(wp.stream_from_torch(stream), sync_enter=False):
            yield

    def _render(self, ticket: _Ticket, tensors: Sequence[torch.Tensor | None]) -> RasterImages:
        """Draw, so that the rasteriser's state is this draw's."""
        self._drawn = None
        if ticket.cameras != self._rasterizer.cameras:  # the same objects are the same cameras
            self._rasterizer.set_cameras(ticket.cameras)
        types = (wp.vec3, wp.quat, wp.vec3, wp.float32, wp.float32, wp.vec3)
        arrays = [
            None if tensor is None else wp.from_torch(tensor.detach(), dtype=dtype)
            for tensor, dtype in zip(tensors, types, strict=True)
        ]
        images = self._rasterizer.draw(GaussianArrays(*arrays))  # pyright: ignore[reportArgumentType]
        self._drawn = ticket
        return images

    def _forward(self, ticket: _Ticket, given: Sequence[torch.Tensor | None]) -> tuple[torch.Tensor | None, ...]:
        """Draw, and copy the images."""
        with self._torch_stream():
            images = self._render(ticket, given)
            arrays = (images.alpha, images.depth, images.median_depth, self._rasterizer.gaussian_ids, *images.channels)
            tensors = self._share("images", images, arrays)
            flat, passes = tensors[:4], tensors[4:]
            channels = [
                torch.cat([passes[i][:, columns] for i, columns, _ in _cuts(block)], dim=1) if block else None
                for block in self._blocks()
            ]
            return (*channels, *(image.clone() for image in flat))

    def _backward(
        self,
        ticket: _Ticket,
        tensors: Sequence[torch.Tensor | None],
        upstream: Sequence[torch.Tensor | None],
        wanted: Sequence[bool],
    ) -> list[torch.Tensor | None]:
        """Differentiate a draw, which is made again if another came after it."""
        with self._torch_stream():
            if self._drawn is not ticket:
                self._render(ticket, tensors)
            adjoints = self._rasterizer.adjoints()
            arrays = (adjoints.alpha, adjoints.depth, adjoints.median_depth, *adjoints.channels)
            targets = self._share("adjoints", adjoints, arrays)
            flat, passes = targets[:3], targets[3:]
            for block, gradient in zip(self._blocks(), upstream[:3], strict=True):
                for i, columns, own in _cuts(block):
                    _put(passes[i][:, columns], None if gradient is None else gradient[:, own])
            for target, gradient in zip(flat, upstream[3:6], strict=True):
                _put(target, gradient)
            found = self._rasterizer.backward()
            gradients = self._share("gradients", found, found)
            return [gradient.clone() if want else None for gradient, want in zip(gradients, wanted, strict=True)]

    def _share(self, name: str, owner: Any, arrays: Sequence[Any]) -> list[Any]:
        """Return tensors over a record's arrays, the same ones as long as it is the same record."""
        held = self._shared.get(name)
        if held is None or held[0] is not owner:
            held = owner, [None if array is None else wp.to_torch(array) for array in arrays]
            self._shared[name] = held
        return held[1]

    def _blocks(self) -> tuple[range, range, range]:
        """The channels of colours, normals and values."""
        drawn = self._rasterizer
        return drawn.color_channels, drawn.normal_channels, drawn.value_channels


class _Draw(torch.autograd.Function):
    """The node of torch's graph."""

    @staticmethod
    def forward(ctx: Any, owner: TorchRasterizer, ticket: _Ticket, *tensors: torch.Tensor | None) -> Any:
        """Draw."""
        images = owner._forward(ticket, tensors)
        ctx.owner, ctx.ticket = owner, ticket
        ctx.save_for_backward(*tensors)
        ctx.mark_non_differentiable(images[-1])
        ctx.set_materialize_grads(False)
        return images

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: torch.Tensor | None) -> Any:
        """Differentiate; torch refuses tensors that were written to since."""
        return None, None, *ctx.owner._backward(ctx.ticket, ctx.saved_tensors, upstream, ctx.needs_input_grad[2:])


def require_tensor(name: str, tensor: Any, shape: tuple[int, ...], device: Any) -> None:
    """Refuse anything but a float32 tensor of a shape on a device."""
    fits = isinstance(tensor, torch.Tensor) and tuple(tensor.shape) == shape
    if not (fits and tensor.dtype == torch.float32 and tensor.device == device):
        raise InvalidArrayError(
            f"{name} must be a tensor of torch.float32 of shape {shape} on {device}, got {describe(tensor)}. Convert, "
            "reshape or move it."
        )


def describe(value: Any) -> str:
    """Describe an argument in an error."""
    if isinstance(value, torch.Tensor):
        return f"a tensor of {value.dtype} of shape {tuple(value.shape)} on {value.device}"
    return repr(value) if isinstance(value, (bool, int, float, str)) else type(value).__name__


def _compact_rows(
    name: str, tensor: torch.Tensor | None, shape: tuple[int, ...] | None, device: torch.device
) -> torch.Tensor | None:
    """Return a tensor that kernels read, its rows brought together; a shape of None wants no tensor."""
    if shape is not None:
        require_tensor(name, tensor, shape, device)
    elif tensor is not None:
        raise InvalidArrayError(
            f"{name} must be left out of what draws none, got a tensor. Make another TorchRasterizer."
        )
    return tensor if tensor is None or tensor.ndim == 1 or tensor.stride(-1) == 1 else tensor.contiguous()


def _cuts(channels: range) -> Iterator[tuple[int, slice, slice]]:
    """Cut channels into passes: which pass, the columns there, and the columns among these channels."""
    longest = CHANNEL_COUNTS[-1]
    start = channels.start
    while start < channels.stop:
        i = start // longest
        end = min(channels.stop, (i + 1) * longest)
        yield i, slice(start - i * longest, end - i * longest), slice(start - channels.start, end - channels.start)
        start = end


def _put(target: torch.Tensor, gradient: torch.Tensor | None) -> None:
    """Write a derivative where the rasteriser reads it; None is 0."""
    if gradient is None:
        target.zero_()
    else:
        target.copy_(gradient)


def _device_name(device: Any) -> str:
    """Name a torch device as Warp does."""
    named = torch.device(device)
    if named.type == "cuda" and named.index is None:
        return f"cuda:{torch.cuda.current_device()}"
    return str(named)
