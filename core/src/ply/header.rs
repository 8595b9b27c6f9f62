//! The header of a PLY file: format, elements and their properties.

use std::io::Read;

/// Encoding of the body.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Format {
    Ascii,
    LittleEndian,
    BigEndian,
}

/// Type of a number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

/// One property of an element; lists are not kept.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Property {
    pub name: String,
    pub kind: Scalar,
}

/// One element.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Element {
    pub name: String,
    pub count: u64,
    pub properties: Vec<Property>,
    /// Whether it has a list property, so that its rows have no fixed size.
    pub has_list: bool,
}

/// A header.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Header {
    pub format: Format,
    pub comments: Vec<String>,
    pub elements: Vec<Element>,
    /// Bytes of the header, the line `end_header` included.
    pub bytes: u64,
}

impl Scalar {
    /// The type by PLY's name, or by the name that other programs use.
    fn from_name(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    pub fn bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// The number in the first [`Scalar::bytes`] of `bytes`.
    pub fn read(self, bytes: &[u8], big_endian: bool) -> f64 {
        let mut raw = [0_u8; 8];
        let len = self.bytes();
        raw[..len].copy_from_slice(&bytes[..len]);
        if big_endian {
            raw[..len].reverse();
        }
        let [b0, b1, b2, b3, ..] = raw;
        match self {
            Self::I8 => f64::from(b0 as i8),
            Self::U8 => f64::from(b0),
            Self::I16 => f64::from(i16::from_le_bytes([b0, b1])),
            Self::U16 => f64::from(u16::from_le_bytes([b0, b1])),
            Self::I32 => f64::from(i32::from_le_bytes([b0, b1, b2, b3])),
            Self::U32 => f64::from(u32::from_le_bytes([b0, b1, b2, b3])),
            Self::F32 => f64::from(f32::from_le_bytes([b0, b1, b2, b3])),
            Self::F64 => f64::from_le_bytes(raw),
        }
    }
}

impl Element {
    /// Bytes of a row in a binary body.
    pub fn row_bytes(&self) -> usize {
        self.properties.iter().map(|property| property.kind.bytes()).sum()
    }
}

impl Header {
    /// Reads up to and including `end_header`; the error message does not name the file.
    pub fn read(file: &mut impl Read) -> Result<Self, String> {
        let mut lines = HeaderLines { file, line: Vec::new(), number: 0, bytes: 0 };
        if lines.next()? != "ply" {
            return Err("is not a PLY file (its first line is not \"ply\")".to_owned());
        }
        let (mut format, mut comments, mut elements) = (None, Vec::new(), Vec::<Element>::new());
        loop {
            let line = lines.next()?.to_owned();
            let refuse = |what: &str| format!("line {} of the header, \"{line}\": {what}", lines.number);
            let words: Vec<&str> = line.split_ascii_whitespace().collect();
            match words.as_slice() {
                ["end_header"] => break,
                [] | ["obj_info", ..] => {}
                ["comment", ..] => comments.push(line["comment".len()..].trim().to_owned()),
                ["format", name, _version] => {
                    format = Some(match *name {
                        "ascii" => Format::Ascii,
                        "binary_little_endian" => Format::LittleEndian,
                        "binary_big_endian" => Format::BigEndian,
                        _ => return Err(refuse("an unknown format")),
                    });
                }
                ["element", name, count] => elements.push(Element {
                    name: (*name).to_owned(),
                    count: count.parse().map_err(|_| refuse("the count is not a number"))?,
                    properties: Vec::new(),
                    has_list: false,
                }),
                ["property", "list", ..] => {
                    elements.last_mut().ok_or_else(|| refuse("a property without an element"))?.has_list =
                        true;
                }
                ["property", kind, name] => {
                    let kind = Scalar::from_name(kind).ok_or_else(|| refuse("an unknown type"))?;
                    let element =
                        elements.last_mut().ok_or_else(|| refuse("a property without an element"))?;
                    element.properties.push(Property { name: (*name).to_owned(), kind });
                }
                _ => return Err(refuse("an unknown kind of line")),
            }
        }
        let bytes = lines.bytes;
        let format = format.ok_or("the header has no format line")?;
        Ok(Self { format, comments, elements, bytes })
    }

    /// The element `vertex`, which must come first.
    pub fn vertex_first(&self) -> Result<&Element, String> {
        match self.elements.as_slice() {
            [first, ..] if first.name == "vertex" && first.has_list => {
                Err("the vertices have a list property, so their rows have no fixed size".to_owned())
            }
            [first, ..] if first.name == "vertex" => Ok(first),
            [first, ..] => Err(format!("the first element is \"{}\", not \"vertex\"", first.name)),
            [] => Err("the header has no element".to_owned()),
        }
    }
}

/// Reads lines byte by byte, so that nothing after the header is consumed.
struct HeaderLines<'a, R> {
    file: &'a mut R,
    line: Vec<u8>,
    number: usize,
    bytes: u64,
}

impl<R: Read> HeaderLines<'_, R> {
    fn next(&mut self) -> Result<&str, String> {
        // A binary file of another kind could be one endless line.
        const MAX_LINE: usize = 4096;
        const MAX_LINES: usize = 10_000;
        self.line.clear();
        self.number += 1;
        loop {
            let mut byte = [0];
            match self.file.read_exact(&mut byte) {
                Ok(()) => {}
                Err(error) if error.kind() == std::io::ErrorKind::UnexpectedEof => {
                    return Err(format!("the header ends in line {} without \"end_header\"", self.number));
                }
                Err(error) => return Err(format!("cannot be read: {error}")),
            }
            self.bytes += 1;
            if byte[0] == b'\n' {
                break;
            }
            self.line.push(byte[0]);
            if self.line.len() > MAX_LINE || self.number > MAX_LINES {
                return Err(self.not_text());
            }
        }
        let line = std::str::from_utf8(&self.line).map_err(|_| self.not_text())?;
        Ok(line.trim_end())
    }

    fn not_text(&self) -> String {
        if self.number == 1 {
            "is not a PLY file (its first line is not \"ply\")".to_owned()
        } else {
            format!("line {} of the header is not text", self.number)
        }
    }
}
