"""Safe loaders and writers of the project's files: capped, validated, never executed, written whole or not at all."""
