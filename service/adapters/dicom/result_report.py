"""The figures as a structured report (Comprehensive 3D SR, TID 1500 Measurement Report; PS3.16)."""

import highdicom as hd
from pydicom.sr.codedict import codes
from pydicom.sr.coding import Code

from model.inference.estimates import Estimate
from service.adapters.dicom.derivation import DISCLAIMER, MANUFACTURER, Derivation
from service.adapters.dicom.laterality import SIDES

#: Scheme of the concepts that no standard vocabulary has.
PRIVATE_SCHEME = "99MORPHOFLOW"
TYPICALITY = Code("typicality", PRIVATE_SCHEME, "Percentile of typicality among the training population")
CONVERGED = Code("fit", PRIVATE_SCHEME, "End of the fit")
LIMITATION = Code("limits", PRIVATE_SCHEME, "Limits of use")
NOT_DIAGNOSTIC = Code("derived", PRIVATE_SCHEME, f"Result is {DISCLAIMER}")
CUT = Code("cut", PRIVATE_SCHEME, "Object is cut at the border of the images")
WARNED = Code("warned", PRIVATE_SCHEME, "Reconstruction carries warnings; do not rely on it")
MILLILITRE = Code("ml", "UCUM", "ml")


def report(derivation: Derivation, segmentation: hd.seg.Segmentation) -> hd.sr.Comprehensive3DSR:
    """Volume and surface area with their 90 % intervals, typicality, and what made them.

    The ends of an interval are given as the upper and lower measurement uncertainty (TID 311).
    """
    context = hd.sr.ObservationContext(observer_device_context=_observer(derivation))
    document = hd.sr.MeasurementReport(
        observation_context=context,
        procedure_reported=Code("363679005", "SCT", "Imaging procedure"),
        imaging_measurements=[_group(derivation, segmentation)],
        title=codes.DCM.ImagingMeasurementReport,
    )
    return hd.sr.Comprehensive3DSR(
        evidence=[segmentation, *derivation.series.images],
        content=document[0],
        is_complete=True,
        is_verified=False,
        series_description=derivation.description("Measurements"),
        **derivation.equipment(),
        **derivation.place("report", "report"),
    )


def _observer(derivation: Derivation) -> hd.sr.ObserverContext:
    device = hd.sr.DeviceObserverIdentifyingAttributes(
        uid=derivation.uid("device"),
        name=MANUFACTURER,
        manufacturer_name=MANUFACTURER,
        model_name=derivation.model,
        serial_number=derivation.outcome.model_digest[:16],
    )
    return hd.sr.ObserverContext(observer_type=codes.DCM.Device, observer_identifying_attributes=device)


def _group(
    derivation: Derivation, segmentation: hd.seg.Segmentation
) -> hd.sr.VolumetricROIMeasurementsAndQualitativeEvaluations:
    answer = derivation.outcome.reconstruction
    evaluations = [(LIMITATION, NOT_DIAGNOSTIC), (CONVERGED, _ending(derivation))]
    evaluations += [(LIMITATION, CUT)] if derivation.is_cut else []
    evaluations += [(LIMITATION, WARNED)] if answer.warnings else []
    return hd.sr.VolumetricROIMeasurementsAndQualitativeEvaluations(
        tracking_identifier=hd.sr.TrackingIdentifier(derivation.uid("tracking"), derivation.label),
        referenced_segment=_segment(derivation, segmentation),
        finding_type=derivation.anatomy,
        finding_sites=[hd.sr.FindingSite(derivation.anatomy, SIDES.get(derivation.side))],
        algorithm_id=_algorithm(derivation),
        measurements=[
            _measurement(codes.SCT.Volume, answer.volume_ml, MILLILITRE),
            _measurement(codes.IBSI.SurfaceAreaOfMesh, answer.area_cm2, codes.UCUM.SquareCentimeter),
            hd.sr.Measurement(TYPICALITY, round(answer.typicality_percentile, 2), codes.UCUM.Percent),
        ],
        qualitative_evaluations=[hd.sr.QualitativeEvaluation(*pair) for pair in evaluations],
    )


def _segment(derivation: Derivation, segmentation: hd.seg.Segmentation) -> hd.sr.ReferencedSegment:
    series = hd.sr.SourceSeriesForSegmentation(derivation.series.images[0].SeriesInstanceUID)
    return hd.sr.ReferencedSegment(segmentation.SOPClassUID, segmentation.SOPInstanceUID, 1, source_series=series)


def _ending(derivation: Derivation) -> Code:
    status = derivation.outcome.reconstruction.state.fits[0].status.value
    return Code(status, PRIVATE_SCHEME, status.replace("_", " ").capitalize())


def _algorithm(derivation: Derivation) -> hd.sr.AlgorithmIdentification:
    parameters = [f"{name}={value}" for name, value in derivation.parameters().items()]
    version = f"{derivation.version}, model {derivation.outcome.model_version}"
    return hd.sr.AlgorithmIdentification(f"{MANUFACTURER} {derivation.outcome.model_name}", version, parameters)


def _measurement(name: Code, estimate: Estimate, unit: Code) -> hd.sr.Measurement:
    properties = None
    if estimate.low is not None and estimate.high is not None:
        properties = hd.sr.MeasurementProperties(
            upper_measurement_uncertainty=_figure(estimate.high - estimate.value),
            lower_measurement_uncertainty=_figure(estimate.value - estimate.low),
        )
    return hd.sr.Measurement(name, _figure(estimate.value), unit, properties=properties)


def _figure(value: float) -> float:
    """Six significant digits, which a decimal string can hold."""
    return float(f"{value:.6g}")
