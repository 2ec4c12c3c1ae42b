//! The record's wire form: a CBOR map with integer keys (RFC 8949), schema in `docs/record.cddl`.
//!
//! Numbers are written in the shortest float that holds them exactly (RFC 8949 section 4.1) and read
//! in any width or as integers. Unknown keys are read over, so that newer tags stay readable.

use minicbor::data::Type;
use minicbor::decode::Error as DecodeError;
use minicbor::encode::{Error as EncodeError, Write};
use minicbor::{Decoder, Encoder};

use crate::Vec3;
use crate::cose;
use crate::record::{
    BoundingBox, Invalid, LandmarkSite, Mobility, Physical, Record, Semantic, Shape, Text,
};

/// Most bytes of a record, on a tag and on the air.
pub const MAX_BYTES: usize = 1024;

/// Why bytes are no record.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// Not the CBOR of the schema.
    #[error("not a record: {0}")]
    Malformed(DecodeError),
    /// A mandatory field is absent.
    #[error("the record lacks {0}")]
    Missing(&'static str),
    /// More bytes follow the record.
    #[error("bytes follow the record")]
    Trailing,
    /// It says something that cannot be true.
    #[error("impossible record: {0}")]
    Invalid(#[from] Invalid),
}

impl From<DecodeError> for RecordError {
    fn from(error: DecodeError) -> Self {
        RecordError::Malformed(error)
    }
}

type Encoded<W> = Result<(), EncodeError<<W as Write>::Error>>;

/// Writes a record as CBOR. Does not validate: call [`Record::validate`] first.
pub fn encode<W: Write>(record: &Record, out: W) -> Encoded<W> {
    let mut e = Encoder::new(out);
    e.map(6)?.u8(0)?.str(&record.object_id)?;
    e.u8(1)?.array(record.landmarks.len() as u64)?;
    for site in &record.landmarks {
        e.array(2)?;
        floats(&mut e, &site.position)?;
        floats(&mut e, &site.normal)?;
    }
    e.u8(2)?;
    floats(&mut e, &record.bounding_box.sides())?;
    e.u8(3)?;
    shape(&mut e, &record.shape)?;
    let Physical { weight, strength, material } = &record.physical;
    let present = [weight.is_some(), strength.is_some(), material.is_some()];
    e.u8(4)?.map(present.iter().filter(|p| **p).count() as u64)?;
    if let Some(weight) = weight {
        e.u8(0)?;
        float(&mut e, *weight)?;
    }
    if let Some(strength) = strength {
        e.u8(1)?;
        float(&mut e, *strength)?;
    }
    if let Some(material) = material {
        e.u8(2)?.str(material)?;
    }
    e.u8(5)?.map(2)?.u8(0)?.str(&record.semantic.name)?;
    e.u8(1)?.u8(match record.semantic.mobility {
        Mobility::Movable => 0,
        Mobility::Fixed => 1,
    })?;
    Ok(())
}

fn float<W: Write>(e: &mut Encoder<W>, value: f64) -> Encoded<W> {
    let single = value as f32;
    if f64::from(single) == value {
        e.f32(single)?
    } else {
        e.f64(value)?
    };
    Ok(())
}

fn floats<W: Write>(e: &mut Encoder<W>, values: &[f64]) -> Encoded<W> {
    e.array(values.len() as u64)?;
    values.iter().try_for_each(|v| float(e, *v))
}

fn shape<W: Write>(e: &mut Encoder<W>, shape: &Shape) -> Encoded<W> {
    match shape {
        Shape::Box => {
            e.array(1)?.u8(0)?;
        }
        Shape::Cylinder { diameter, height } => {
            e.array(2)?.u8(1)?;
            floats(e, &[*diameter, *height])?;
        }
        Shape::Cup { top_diameter, bottom_diameter, height } => {
            e.array(2)?.u8(2)?;
            floats(e, &[*top_diameter, *bottom_diameter, *height])?;
        }
        Shape::Sphere { diameter } => {
            e.array(2)?.u8(3)?;
            floats(e, &[*diameter])?;
        }
        Shape::Prism { outline, height } => {
            e.array(3)?.u8(4)?;
            floats(e, &[*height])?;
            e.array(outline.len() as u64)?;
            outline.iter().try_for_each(|corner| floats(e, corner))?;
        }
        Shape::Convex { vertices } => {
            e.array(2)?.u8(5)?.array(vertices.len() as u64)?;
            vertices.iter().try_for_each(|vertex| floats(e, vertex))?;
        }
    }
    Ok(())
}

/// Reads and validates a record, plain or in the envelope of a signature, which is not checked here.
pub fn decode(bytes: &[u8]) -> Result<Record, RecordError> {
    if cose::is_signed(bytes) {
        return plain(cose::open(bytes)?.payload);
    }
    plain(bytes)
}

fn plain(bytes: &[u8]) -> Result<Record, RecordError> {
    let mut d = Decoder::new(bytes);
    let (mut id, mut landmarks, mut sides, mut form) = (None, None, None, None);
    let (mut physical, mut semantic) = (Physical::default(), Semantic::default());
    entries(&mut d, |d, key| {
        match key {
            0 => id = Some(text(d)?),
            1 => landmarks = Some(list(d, site)?),
            2 => sides = Some(numbers::<3>(d)?),
            3 => form = Some(read_shape(d)?),
            4 => entries(d, |d, key| {
                match key {
                    0 => physical.weight = Some(number(d)?),
                    1 => physical.strength = Some(number(d)?),
                    2 => physical.material = Some(text(d)?),
                    _ => d.skip()?,
                }
                Ok(())
            })?,
            5 => entries(d, |d, key| {
                match key {
                    0 => semantic.name = text(d)?,
                    1 => {
                        semantic.mobility = match d.u8()? {
                            0 => Mobility::Movable,
                            1 => Mobility::Fixed,
                            _ => return Err(DecodeError::message("unknown mobility")),
                        }
                    }
                    _ => d.skip()?,
                }
                Ok(())
            })?,
            _ => d.skip()?,
        }
        Ok(())
    })?;
    if d.position() != bytes.len() {
        return Err(RecordError::Trailing);
    }
    let [width, length, height] = sides.ok_or(RecordError::Missing("bounding_box"))?;
    let record = Record {
        object_id: id.ok_or(RecordError::Missing("object_id"))?,
        landmarks: landmarks.ok_or(RecordError::Missing("landmarks"))?,
        bounding_box: BoundingBox { width, length, height },
        shape: form.ok_or(RecordError::Missing("shape"))?,
        physical,
        semantic,
    };
    record.validate()?;
    Ok(record)
}

/// Walks a definite map with unsigned keys; other keys and their values are read over.
pub(crate) fn entries<'b>(
    d: &mut Decoder<'b>,
    mut entry: impl FnMut(&mut Decoder<'b>, u64) -> Result<(), DecodeError>,
) -> Result<(), DecodeError> {
    let count = d.map()?.ok_or_else(|| DecodeError::message("maps must have a length"))?;
    for _ in 0..count {
        match d.datatype()? {
            Type::U8 | Type::U16 | Type::U32 | Type::U64 => {
                let key = d.u64()?;
                entry(d, key)?;
            }
            _ => {
                d.skip()?;
                d.skip()?;
            }
        }
    }
    Ok(())
}

fn text(d: &mut Decoder<'_>) -> Result<Text, DecodeError> {
    Text::try_from(d.str()?).map_err(|_| DecodeError::message("text longer than 48 bytes"))
}

fn number(d: &mut Decoder<'_>) -> Result<f64, DecodeError> {
    match d.datatype()? {
        Type::F16 => d.f16().map(f64::from),
        Type::F32 => d.f32().map(f64::from),
        Type::F64 => d.f64(),
        _ => d.i32().map(f64::from),
    }
}

fn length(d: &mut Decoder<'_>) -> Result<u64, DecodeError> {
    d.array()?.ok_or_else(|| DecodeError::message("arrays must have a length"))
}

fn numbers<const N: usize>(d: &mut Decoder<'_>) -> Result<[f64; N], DecodeError> {
    if length(d)? != N as u64 {
        return Err(DecodeError::message("a list of numbers has the wrong length"));
    }
    let mut values = [0.0; N];
    for value in &mut values {
        *value = number(d)?;
    }
    Ok(values)
}

fn list<'b, T, const N: usize>(
    d: &mut Decoder<'b>,
    mut item: impl FnMut(&mut Decoder<'b>) -> Result<T, DecodeError>,
) -> Result<heapless::Vec<T, N>, DecodeError> {
    let mut out = heapless::Vec::new();
    for _ in 0..length(d)? {
        out.push(item(d)?).map_err(|_| DecodeError::message("a list is longer than allowed"))?;
    }
    Ok(out)
}

fn site(d: &mut Decoder<'_>) -> Result<LandmarkSite, DecodeError> {
    if length(d)? != 2 {
        return Err(DecodeError::message("a landmark is a position and a normal"));
    }
    let position: Vec3 = numbers(d)?;
    Ok(LandmarkSite { position, normal: numbers(d)? })
}

fn read_shape(d: &mut Decoder<'_>) -> Result<Shape, DecodeError> {
    let parts = length(d)?;
    let kind = d.u8()?;
    let expected = match kind {
        0 => 1,
        4 => 3,
        _ => 2,
    };
    if parts != expected {
        return Err(DecodeError::message("the shape has the wrong number of parts"));
    }
    Ok(match kind {
        0 => Shape::Box,
        1 => {
            let [diameter, height] = numbers(d)?;
            Shape::Cylinder { diameter, height }
        }
        2 => {
            let [top_diameter, bottom_diameter, height] = numbers(d)?;
            Shape::Cup { top_diameter, bottom_diameter, height }
        }
        3 => {
            let [diameter] = numbers(d)?;
            Shape::Sphere { diameter }
        }
        4 => {
            let [height] = numbers(d)?;
            Shape::Prism { outline: list(d, numbers)?, height }
        }
        5 => Shape::Convex { vertices: list(d, numbers)? },
        _ => return Err(DecodeError::message("unknown shape")),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn shapes() -> impl Strategy<Value = (Shape, Vec3)> {
        (0.01f64..0.5, 0.01f64..0.5, 0.01f64..0.5).prop_flat_map(|(a, b, c)| {
            let prism = heapless::Vec::from_slice(&[
                [-a / 2.0, -b / 2.0],
                [a / 2.0, -b / 2.0],
                [0.0, b / 2.0],
            ]);
            let tetra = heapless::Vec::from_slice(&[
                [a / 2.0, b / 2.0, c / 2.0],
                [-a / 2.0, -b / 2.0, c / 2.0],
                [-a / 2.0, b / 2.0, -c / 2.0],
                [a / 2.0, -b / 2.0, -c / 2.0],
            ]);
            prop_oneof![
                Just((Shape::Box, [a, b, c])),
                Just((Shape::Cylinder { diameter: a, height: c }, [a, a, c])),
                Just((
                    Shape::Cup { top_diameter: a, bottom_diameter: a * 0.7, height: c },
                    [a, a, c]
                )),
                Just((Shape::Sphere { diameter: b }, [b, b, b])),
                Just((Shape::Prism { outline: prism.unwrap(), height: c }, [a, b, c])),
                Just((Shape::Convex { vertices: tetra.unwrap() }, [a, b, c])),
            ]
        })
    }

    fn records() -> impl Strategy<Value = Record> {
        (shapes(), "[a-z]{1,20}", prop::option::of(0.001f64..5.0), any::<bool>()).prop_map(
            |((shape, [width, length, height]), name, weight, fixed)| Record {
                object_id: Text::try_from(name.as_str()).unwrap(),
                landmarks: heapless::Vec::from_slice(&[LandmarkSite {
                    position: [width / 2.0, 0.0, 0.0],
                    normal: [1.0, 0.0, 0.0],
                }])
                .unwrap(),
                bounding_box: BoundingBox { width, length, height },
                shape,
                physical: Physical { weight, strength: Some(20.0), material: None },
                semantic: Semantic {
                    name: Text::try_from("thing").unwrap(),
                    mobility: if fixed { Mobility::Fixed } else { Mobility::Movable },
                },
            },
        )
    }

    fn bytes(record: &Record) -> std::vec::Vec<u8> {
        let mut out = std::vec::Vec::new();
        encode(record, &mut out).unwrap();
        out
    }

    proptest! {
        #[test]
        fn what_is_written_reads_back(record in records()) {
            let wire = bytes(&record);
            prop_assert!(wire.len() <= 512, "{} bytes", wire.len());
            prop_assert_eq!(decode(&wire).unwrap(), record);
        }

        #[test]
        fn no_bytes_panic(mut wire in records().prop_map(|r| bytes(&r)), at in any::<prop::sample::Index>(), value: u8, cut in any::<prop::sample::Index>()) {
            let at = at.index(wire.len());
            wire[at] = value;
            let _ = decode(&wire);
            let _ = decode(&wire[..cut.index(wire.len())]);
        }
    }

    #[test]
    fn unknown_keys_are_read_over() {
        let record = r#"{"object_id": "can", "landmarks": [{"position": [0.03, 0, 0], "normal": [1, 0, 0]}],
            "bounding_box": {"width": 0.06, "length": 0.06, "height": 0.12},
            "shape": {"kind": "cylinder", "diameter": 0.06, "height": 0.12}}"#;
        let record: Record = serde_json::from_str(record).unwrap();
        let mut wire = bytes(&record);
        wire[0] = 0xa7; // a map of seven
        wire.extend([0x18, 0x63, 0x82, 0x01, 0x61, 0x78]); // 99: [1, "x"]
        assert_eq!(decode(&wire).unwrap(), record);
        assert!(matches!(decode(&bytes(&record)[..20]), Err(RecordError::Malformed(_))));
        assert!(matches!(decode(&[0xa0]), Err(RecordError::Missing("bounding_box"))));
    }

    #[test]
    fn nan_on_the_wire_is_refused_by_name() {
        let mut record: Record = serde_json::from_str(
            r#"{"object_id": "x", "landmarks": [{"position": [0, 0, 0], "normal": [1, 0, 0]}],
                "bounding_box": {"width": 1, "length": 1, "height": 1}, "shape": {"kind": "box"}}"#,
        )
        .unwrap();
        record.bounding_box.length = f64::NAN;
        let error = decode(&bytes(&record)).unwrap_err();
        assert_eq!(
            error.to_string(),
            "impossible record: bounding_box.length is not a finite number"
        );
    }
}
