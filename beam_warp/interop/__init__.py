"""Gaussians drawn from other frameworks: gsplat's arguments in, torch gradients out."""

from beam_warp.interop.gsplat import rasterization as rasterization
