"""Fitting and tracking Gaussians: parameters, regularisers, skinning, and the visual hull."""
