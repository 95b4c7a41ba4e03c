"""3-D shape of catheters, continuum robots and other slender tubes from calibrated cameras.

Research use only, not a medical device.
"""

__version__ = "0.1.0"
