"""The version, which files that only this one understands carry."""

VERSION = "0.1.0"
