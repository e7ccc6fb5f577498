"""Closing the loop: measurement models and the receivers that steer the NCOs."""
