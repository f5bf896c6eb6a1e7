"""Reduction: the fewest Gaussians whose relit images stay within a bound, and a certificate of it."""
