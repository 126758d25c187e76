"""The commands: configuration in, objects built, results out."""
