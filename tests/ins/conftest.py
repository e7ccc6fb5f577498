"""Property tests here call compiled kernels: the first example pays for the compilation."""

from hypothesis import settings

settings.register_profile("compiled", deadline=None, max_examples=60)
settings.load_profile("compiled")
