"""Repositories with a judgement each: honest ones in many styles, others with one fault."""
