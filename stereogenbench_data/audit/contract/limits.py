"""The doctor's limits: where something is called wrong, sure, or not testable.

They were set on drawn scenes of 96 to 170 pixels, right ones and copies with one thing made wrong,
so that no right scene is accused. Where one has another source, it says so.
"""

from typing import Final

# A comparison of two contracts, in dB of the squared differences of pictures.
LEAST_DB: Final = 0.15
"""Smaller mean differences, which interpolation and codecs cause, are not believed."""
LEAST_DB_ELSEWHERE: Final = 0.4
"""The same between contracts that read depth elsewhere (lag, order, flip) or in another form: with
small disparities interpolation alone causes 0.3 dB between neighbouring lags."""
LEAST_ERRORS: Final = 3.0
"""How many standard errors a difference must be from 0 to be believed."""
LEAST_ERROR_DB: Final = 1e-3
LEAST_SCALE_DB: Final = 0.02
SCALE_ERRORS: Final = 1.5
"""The same for a scale, which is also judged by its own standard error."""
FINE_CAP: Final = 0.05
"""The share of the cap that a pixel counts where contracts differ a little at many pixels."""
FEWEST_POINTS: Final = 40
"""Pixels of a view, for it to count."""

# What a scene must show to be judged.
MOST_RESIDUAL_PX: Final = 0.5
"""Rigs with a larger rectification residual are left out: they need more than disparity."""
FEWEST_MATCHES: Final = 200
COARSEST_STEP: Final = 0.5
"""The largest relative step of stored depth."""
LEAST_PARALLAX_PX: Final = 0.3
"""Smaller disparities (root mean square) are noise."""
BIAS_PX: Final = 0.1
"""Systematic error of disparity, by interpolation on small pictures."""

# The depth scale.
LEAST_LOG_SCALE: Final = 0.01
"""A smaller error of it is not called wrong."""
MARGIN: Final = 0.02
"""It is confirmed if its 95 % interval is within this share of the declared one."""
LEAST_TOLERANCE: Final = 0.005
"""It may be off by this share even where its interval is narrower."""
SCALE_BIAS: Final = 0.002
"""Its systematic error, as a share, by interpolation and rounding."""
RAY_BIAS: Final = 0.15
"""Systematic error of the power of the ray; up to 0.19 was measured at long focal lengths."""

# One camera beside the others.
FEWEST_OF_CAMERA: Final = 100
"""Matches of a pair, or of a camera with its neighbours, for it to be tested."""
LEAST_SHARE: Final = 0.5
"""Least share of a camera's matches with its neighbours that its depth must explain."""
MOST_LOG_SCALE: Final = 0.005
MOST_SHIFT_PX: Final = 0.25
"""Beyond these a camera differs from the others: scale of its depth, shift of pictures."""
LEAST_DEFICIT: Final = 0.12
LEAST_UNLIKE: Final = 0.05
"""Least share of matches that a camera's pairs lack, compared with other pairs as wide: matches
that either depth explains, and those of them in which both depths agree (2 % in correct data)."""
MOST_APART_PX: Final = 0.25
"""Two depths of a point agree if their disparities differ by fewer pixels."""
LEAST_GAIN: Final = 0.01
LEAST_CLOSED: Final = 1 / 3
"""Least share of all points, and of those lacking, that another reading of depth must explain."""
GAIN_ERRORS: Final = 5.0
"""About 70 readings are tried in a scene, so 3 standard errors occur by chance."""
LEAST_LEAD: Final = 1.1
"""How many times as much the right lag of a camera's pictures explains as the next best."""
