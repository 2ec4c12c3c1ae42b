//! What a ROS 2 message is: one list of fields that gives the struct, its bytes and its schema text.
//!
//! The macro `messages!` takes the fields with their Rust types, as `msg` uses it. A [`Field`] knows how it
//! is written in CDR and what ROS calls it; so encoding and schema cannot drift apart.

use crate::cdr::{CdrError, Reader, Writer};

/// A value that can be a field of a message.
pub trait Field: Sized {
    /// The fewest bytes that a value takes; bounds the memory that a hostile count can claim.
    const SMALLEST: usize;
    /// What a `.msg` file calls the type.
    fn type_name() -> String;
    /// Lists the definitions that the type needs, each once, outermost first.
    fn definitions(_list: &mut Vec<Definition>) {}
    /// Appends the value.
    fn encode(&self, writer: &mut Writer);
    /// Reads a value.
    fn decode(reader: &mut Reader) -> Result<Self, CdrError>;
    /// Appends many values.
    fn encode_all(values: &[Self], writer: &mut Writer) {
        for value in values {
            value.encode(writer);
        }
    }
    /// Reads many values.
    fn decode_all(count: usize, reader: &mut Reader) -> Result<Vec<Self>, CdrError> {
        (0..count).map(|_| Self::decode(reader)).collect()
    }
}

/// One message type's fields as in its `.msg` file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Definition {
    /// Package and name, such as `std_msgs/Header`.
    pub name: String,
    /// One `type name` line per field.
    pub fields: String,
}

/// A ROS 2 message that can be recorded.
pub trait Message: Field {
    /// Full name, such as `std_msgs/msg/Header`.
    const TYPE: &'static str;

    /// The schema text (`ros2msg`): own fields first, then every type used, under lines of `=`.
    fn schema() -> String {
        let mut list = Vec::new();
        Self::definitions(&mut list);
        let mut text = String::new();
        for (index, definition) in list.iter().enumerate() {
            if index > 0 {
                text += &format!("{}\nMSG: {}\n", "=".repeat(80), definition.name);
            }
            text += &definition.fields;
        }
        text
    }

    /// The message as CDR bytes.
    fn to_cdr(&self) -> Vec<u8> {
        let mut writer = Writer::default();
        self.encode(&mut writer);
        writer.finish()
    }

    /// The message of CDR bytes. Bytes after the message are ignored, as ROS does.
    fn from_cdr(bytes: &[u8]) -> Result<Self, CdrError> {
        Self::decode(&mut Reader::new(bytes)?)
    }
}

macro_rules! numbers {
    ($($rust:ty => $ros:literal),*) => {$(
        impl Field for $rust {
            const SMALLEST: usize = size_of::<$rust>();
            fn type_name() -> String {
                $ros.into()
            }
            fn encode(&self, writer: &mut Writer) {
                writer.number(self.to_le_bytes());
            }
            fn decode(reader: &mut Reader) -> Result<Self, CdrError> {
                Ok(<$rust>::from_le_bytes(reader.number()?))
            }
        }
    )*};
}

numbers!(i32 => "int32", u32 => "uint32", f64 => "float64");

impl Field for u8 {
    const SMALLEST: usize = 1;
    fn type_name() -> String {
        "uint8".into()
    }
    fn encode(&self, writer: &mut Writer) {
        writer.raw(&[*self]);
    }
    fn decode(reader: &mut Reader) -> Result<Self, CdrError> {
        let [byte] = reader.number()?;
        Ok(byte)
    }
    // Pixels: one copy instead of a loop.
    fn encode_all(values: &[Self], writer: &mut Writer) {
        writer.raw(values);
    }
    fn decode_all(count: usize, reader: &mut Reader) -> Result<Vec<Self>, CdrError> {
        Ok(reader.raw(count)?.to_vec())
    }
}

impl Field for bool {
    const SMALLEST: usize = 1;
    fn type_name() -> String {
        "bool".into()
    }
    fn encode(&self, writer: &mut Writer) {
        u8::from(*self).encode(writer);
    }
    fn decode(reader: &mut Reader) -> Result<Self, CdrError> {
        Ok(u8::decode(reader)? != 0)
    }
}

impl Field for String {
    const SMALLEST: usize = 4;
    fn type_name() -> String {
        "string".into()
    }
    fn encode(&self, writer: &mut Writer) {
        writer.text(self);
    }
    fn decode(reader: &mut Reader) -> Result<Self, CdrError> {
        Ok(reader.text()?.into())
    }
}

impl<T: Field> Field for Vec<T> {
    const SMALLEST: usize = 4;
    fn type_name() -> String {
        format!("{}[]", T::type_name())
    }
    fn definitions(list: &mut Vec<Definition>) {
        T::definitions(list);
    }
    fn encode(&self, writer: &mut Writer) {
        writer.count(self.len());
        T::encode_all(&self[..Writer::fits(self.len())], writer);
    }
    fn decode(reader: &mut Reader) -> Result<Self, CdrError> {
        let count = reader.count(T::SMALLEST)?;
        T::decode_all(count, reader)
    }
}

impl<const N: usize> Field for [f64; N] {
    const SMALLEST: usize = 8 * N;
    fn type_name() -> String {
        format!("float64[{N}]")
    }
    fn encode(&self, writer: &mut Writer) {
        f64::encode_all(self, writer);
    }
    fn decode(reader: &mut Reader) -> Result<Self, CdrError> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = f64::decode(reader)?;
        }
        Ok(values)
    }
}

/// Defines message structs of one package, see the module's text.
macro_rules! messages {
    ($package:literal; $(
        $(#[$doc:meta])*
        $name:ident { $($(#[$field_doc:meta])* $field:ident: $type:ty,)* }
    )*) => {$(
        $(#[$doc])*
        #[derive(Debug, Clone, PartialEq)]
        pub struct $name { $($(#[$field_doc])* pub $field: $type,)* }

        impl $crate::message::Field for $name {
            const SMALLEST: usize = 0 $(+ <$type as $crate::message::Field>::SMALLEST)*;

            fn type_name() -> std::string::String {
                concat!($package, "/", stringify!($name)).into()
            }

            fn definitions(list: &mut Vec<$crate::message::Definition>) {
                let name = Self::type_name();
                if list.iter().any(|known| known.name == name) {
                    return;
                }
                let mut fields = std::string::String::new();
                $(
                    fields += &<$type as $crate::message::Field>::type_name();
                    fields += concat!(" ", stringify!($field), "\n");
                )*
                list.push($crate::message::Definition { name, fields });
                $(<$type as $crate::message::Field>::definitions(list);)*
            }

            fn encode(&self, writer: &mut $crate::cdr::Writer) {
                $($crate::message::Field::encode(&self.$field, writer);)*
            }

            fn decode(
                reader: &mut $crate::cdr::Reader,
            ) -> Result<Self, $crate::cdr::CdrError> {
                Ok($name { $($field: $crate::message::Field::decode(reader)?,)* })
            }
        }

        impl $crate::message::Message for $name {
            const TYPE: &'static str = concat!($package, "/msg/", stringify!($name));
        }
    )*};
}

pub(crate) use messages;
