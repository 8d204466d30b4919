from walks import make_env

__all__ = ["make_env"]
