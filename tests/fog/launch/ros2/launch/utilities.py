"""Texts and substitutions."""


def normalize_to_list_of_substitutions(said):
    return [said] if isinstance(said, str) or hasattr(said, "perform") else list(said)


def perform_substitutions(context, parts):
    return "".join(part if isinstance(part, str) else part.perform(context) for part in parts)
