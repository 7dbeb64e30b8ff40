"""The records every stage exchanges (Log, Grasps), their files, materials, examples and splits."""
