"""The methods, each to be read like the method section of a paper; one file a method."""
