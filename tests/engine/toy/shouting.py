"""A helper that one stage uses."""


def shout(text: str, mark: str) -> str:
    """Upper case and a mark."""
    return text.upper() + mark  # loud
