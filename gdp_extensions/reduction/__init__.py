"""Reductions of messages: region and voxels, picture files, compression, and adaptation to the path. Sans-I/O."""

from gdp_extensions.reduction.adaptation import adaptation_of
from gdp_extensions.reduction.encoder import RestoringExpander, encoders_of

__all__ = ["RestoringExpander", "adaptation_of", "encoders_of"]
