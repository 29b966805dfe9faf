"""The mesh in two objects: Encapsulated STL and Surface Segmentation (PS3.3, A.85.1 and A.57), in LPS mm."""

import highdicom as hd
from pydicom import Dataset
from pydicom.sequence import Sequence
from pydicom.sr.codedict import codes
from pydicom.sr.coding import Code
from pydicom.uid import EncapsulatedSTLStorage, SurfaceSegmentationStorage

from model.inference.mesh import Mesh, transformed
from service.adapters.dicom.derivation import MANUFACTURER, Derivation, algorithm, property_type, references
from service.adapters.image_guard import LPS_TO_RAS
from service.adapters.mesh_formats import write_mesh
from service.provenance import metadata_of

#: Grey value and CIELab colour that viewers show the surface in.
GREY, CIELAB = 0xB000, (0xB000, 0xA000, 0xA400)


def encapsulated_stl(derivation: Derivation) -> Dataset:
    """The surface as a binary STL file within an object."""
    found = _object(derivation, EncapsulatedSTLStorage, "M3D", "model", "stl")
    outcome = derivation.outcome
    document = write_mesh(outcome.reconstruction.mesh, "stl", space="LPS", metadata=metadata_of(outcome))
    found.BurnedInAnnotation, found.RecognizableVisualFeatures = "NO", "NO"
    found.DocumentTitle = derivation.description("Surface")
    found.ConceptNameCodeSequence = _coded(Code("85040-5", "LN", "CT or MR Guidance surface"))
    found.MIMETypeOfEncapsulatedDocument = "model/stl"
    found.EncapsulatedDocumentLength = len(document)
    found.EncapsulatedDocument = document + b"\0" * (len(document) % 2)
    found.AcquisitionDateTime = None
    found.MeasurementUnitsCodeSequence = _coded(codes.UCUM.Millimeter)
    found.ModelModification, found.ModelMirroring = "NO", "NO"
    found.ModelUsageCodeSequence = _coded(Code("129016", "DCM", "Visualization"))
    found.ContentDescription = derivation.description("Surface")
    found.SourceInstanceSequence = Sequence(references(derivation))
    return found


def surface_segmentation(derivation: Derivation) -> Dataset:
    """The surface as points, normals and triangles of one segment."""
    found = _object(derivation, SurfaceSegmentationStorage, "SEG", "segmentation", "surface", number=2)
    found.ContentLabel, found.ContentDescription = "SURFACE", derivation.description("Surface")
    found.ContentCreatorName = MANUFACTURER
    mesh = transformed(derivation.outcome.reconstruction.mesh, LPS_TO_RAS)
    found.NumberOfSurfaces = 1
    found.SurfaceSequence = Sequence([_surface(mesh)])
    found.SegmentSequence = Sequence([_segment(derivation)])
    return found


def _object(derivation: Derivation, kind: str, modality: str, series: str, name: str, number: int = 1) -> Dataset:
    """Patient, study, frame of reference, equipment and references, as all objects of a study have them."""
    image = derivation.series.images[0]
    found = hd.SOPClass(
        study_instance_uid=image.StudyInstanceUID,
        sop_class_uid=kind,
        modality=modality,
        transfer_syntax_uid="1.2.840.10008.1.2.1",
        specific_character_set=image.get("SpecificCharacterSet"),
        series_description=derivation.description("Segmentation" if series == "segmentation" else "Surface"),
        **derivation.equipment(),
        **derivation.place(series, name, number),
    )
    found.copy_patient_and_study_information(image)
    found.FrameOfReferenceUID, found.PositionReferenceIndicator = image.FrameOfReferenceUID, None
    _refer(found, derivation)
    return found


def _refer(found: Dataset, derivation: Derivation) -> None:
    """The common instance references (C.12.2); a drawing may be kept in another study than its images."""
    drawing, *images = references(derivation)
    drawn = _series_reference(derivation.drawing, [drawing])
    shown = _series_reference(derivation.series.images[0], images)
    if derivation.drawing.StudyInstanceUID == found.StudyInstanceUID:
        found.ReferencedSeriesSequence = Sequence([drawn, shown])
        return
    found.ReferencedSeriesSequence = Sequence([shown])
    study = Dataset()
    study.StudyInstanceUID, study.ReferencedSeriesSequence = derivation.drawing.StudyInstanceUID, Sequence([drawn])
    found.StudiesContainingOtherReferencedInstancesSequence = Sequence([study])


def _series_reference(source: Dataset, instances: list[Dataset]) -> Dataset:
    item = Dataset()
    item.SeriesInstanceUID, item.ReferencedInstanceSequence = source.SeriesInstanceUID, Sequence(instances)
    return item


def _surface(mesh: Mesh) -> Dataset:
    surface, points, normals, triangles = Dataset(), Dataset(), Dataset(), Dataset()
    points.NumberOfSurfacePoints = len(mesh.vertices)
    points.PointCoordinatesData = mesh.vertices.astype("<f4").tobytes()
    normals.NumberOfVectors, normals.VectorDimensionality = len(mesh.normals), 3
    normals.VectorCoordinateData = mesh.normals.astype("<f4").tobytes()
    triangles.LongTrianglePointIndexList = (mesh.faces + 1).astype("<u4").tobytes()
    triangles.LongEdgePointIndexList = triangles.LongVertexPointIndexList = None
    triangles.TriangleStripSequence = triangles.TriangleFanSequence = Sequence()
    triangles.LineSequence = triangles.FacetSequence = Sequence()
    surface.SurfaceNumber, surface.SurfaceProcessing = 1, "NO"
    surface.RecommendedDisplayGrayscaleValue, surface.RecommendedDisplayCIELabValue = GREY, list(CIELAB)
    surface.RecommendedPresentationOpacity, surface.RecommendedPresentationType = 1.0, "SURFACE"
    surface.FiniteVolume, surface.Manifold = "YES", "YES"
    surface.SurfacePointsSequence = Sequence([points])
    surface.SurfacePointsNormalsSequence = Sequence([normals])
    surface.SurfaceMeshPrimitivesSequence = Sequence([triangles])
    return surface


def _segment(derivation: Derivation) -> Dataset:
    segment, surface = Dataset(), Dataset()
    segment.SegmentNumber, segment.SegmentLabel = 1, derivation.label
    segment.SegmentedPropertyCategoryCodeSequence = _coded(codes.SCT.AnatomicalStructure)
    segment.SegmentedPropertyTypeCodeSequence = Sequence([property_type(derivation)])
    segment.SegmentAlgorithmType, segment.SurfaceCount = "SEMIAUTOMATIC", 1
    surface.ReferencedSurfaceNumber = 1
    surface.SegmentSurfaceGenerationAlgorithmIdentificationSequence = algorithm(derivation)
    surface.SegmentSurfaceSourceInstanceSequence = Sequence(references(derivation))
    segment.ReferencedSurfaceSequence = Sequence([surface])
    return segment


def _coded(code: Code) -> Sequence:
    return Sequence([hd.sr.CodedConcept.from_code(code)])
