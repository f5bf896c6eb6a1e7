"""Renderers: deferred shading in real time, path tracing offline, and pictures of channels."""
