"""What crosses the wire and is not plain: spaces, generators, tensors; pickles on their way in."""
