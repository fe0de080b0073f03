"""One file a stage: load its inputs, call the core, save, return a reference (docs/architecture.md, "Stages")."""
