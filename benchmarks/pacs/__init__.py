"""The service beside a real archive (Orthanc): the scene, and many studies at once."""
