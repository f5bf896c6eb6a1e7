"""Renderers: shadow maps, deferred shading, and path tracing."""
