//! The messages as a header for C and C++: structures with their offsets asserted, codes, limits.

use std::fmt::Write as _;

use delmpc_messages::{
    Command, Heartbeat, MAX_FEET, MAX_JOINTS, MAX_RATE_SAMPLES, MAX_SEGMENTS, Message, PlantState,
};

use super::codes;
use super::layout::{Field, Layout, layouts};

/// The header as `shared/messages/delmpc.h` holds it.
pub fn c_header() -> String {
    let mut text = "/* The messages between plant and controller, little-endian. Written by `delmpc wire --c` from the Rust types.\n \
                    * What they mean and what a plant has to do: shared/messages/WIRE.md. */\n\
                    #ifndef DELMPC_H\n#define DELMPC_H\n\n#include <stddef.h>\n#include <stdint.h>\n\n\
                    #ifdef __cplusplus\n#define DELMPC_ASSERT(what) static_assert(what, #what)\n#else\n\
                    #define DELMPC_ASSERT(what) _Static_assert(what, #what)\n#endif\n\n"
        .to_owned();
    for (name, value) in [
        ("JOINTS", MAX_JOINTS),
        ("FEET", MAX_FEET),
        ("SEGMENTS", MAX_SEGMENTS),
        ("RATE_SAMPLES", MAX_RATE_SAMPLES),
    ] {
        let _ = writeln!(text, "#define DELMPC_MAX_{name} {value}");
    }
    text.push('\n');
    message::<PlantState>(&mut text);
    message::<Command>(&mut text);
    message::<Heartbeat>(&mut text);
    for (field, set) in codes() {
        let field = field.split([' ', ',']).next().unwrap_or(field);
        let _ = writeln!(text, "\n/* {field} */");
        for (name, code, meaning) in set {
            let name = format!("DELMPC_{}_{}", capitals(field), capitals(&name));
            let _ = writeln!(text, "#define {name} {code}u /* {} */", meaning.replace("*/", "* /"));
        }
    }
    for layout in layouts() {
        structure(&mut text, &layout);
    }
    text + "\n#endif\n"
}

fn message<M: Message>(text: &mut String) {
    let name = capitals(M::NAME.split('/').nth(1).unwrap_or_default());
    let _ = writeln!(
        text,
        "#define DELMPC_{name}_PAYLOAD \"{}\"\n#define DELMPC_{name}_MAGIC {:#010x}u\n#define DELMPC_{name}_VERSION {}u",
        M::NAME,
        M::MAGIC,
        M::VERSION
    );
}

fn structure(text: &mut String, layout: &Layout) {
    let name = type_name(layout.name);
    let _ = writeln!(text, "\ntypedef struct {name} {{");
    for field in &layout.fields {
        let Field { name, kind, shape, unit, frame, .. } = field;
        let kind = match *kind {
            "u32" => "uint32_t".to_owned(),
            "u64" => "uint64_t".to_owned(),
            "f64" => "double".to_owned(),
            part => type_name(part),
        };
        let lengths: String = shape.iter().map(|length| format!("[{length}]")).collect();
        let remark: Vec<&str> = [*unit, *frame].into_iter().filter(|part| !part.is_empty()).collect();
        let remark = if remark.is_empty() { String::new() } else { format!(" /* {} */", remark.join(", ")) };
        let _ = writeln!(text, "    {kind} {name}{lengths};{remark}");
    }
    let _ = writeln!(text, "}} {name};");
    for field in &layout.fields {
        let _ = writeln!(text, "DELMPC_ASSERT(offsetof({name}, {}) == {});", field.name, field.offset);
    }
    let _ = writeln!(text, "DELMPC_ASSERT(sizeof({name}) == {});", layout.size);
}

/// `PlantState` as `delmpc_plant_state`.
fn type_name(name: &str) -> String {
    format!("delmpc_{}", capitals(name).to_lowercase())
}

/// `FreshSolution`, `feet.flags`, `WRENCH` as `FRESH_SOLUTION`, `FEET_FLAGS`, `WRENCH`.
fn capitals(name: &str) -> String {
    let mut text = String::new();
    let mut before = ' ';
    for letter in name.chars() {
        if letter.is_ascii_uppercase() && before.is_ascii_lowercase() {
            text.push('_');
        }
        text.push(if letter == '.' { '_' } else { letter.to_ascii_uppercase() });
        before = letter;
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_those_of_c() {
        let names = ["FreshSolution", "feet.flags", "WRENCH", "PlantState"].map(capitals);
        assert_eq!(names, ["FRESH_SOLUTION", "FEET_FLAGS", "WRENCH", "PLANT_STATE"]);
    }
}
