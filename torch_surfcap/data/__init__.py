"""Photographs, calibration and silhouettes: everything that is read before a fit."""
