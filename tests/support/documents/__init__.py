"""Documents that are written from the code, and the blocks of code in the others."""
