"""Inertial navigation: Earth, attitude, trajectories, sensors, strapdown, error state."""
