//! Constants of the shader sources as Rust sees them, so that the host repeats none: `const` and
//! `#define` at file scope whose value is a number, or an expression of numbers and earlier
//! constants of the same file. What depends on a macro that the host or the device chooses is no
//! constant and is left out.
use std::collections::BTreeMap;
use std::fmt::Write;

/// One constant.
#[derive(Clone, Debug, PartialEq)]
pub struct Constant {
    pub name: String,
    /// One number, or those of a vector or array.
    pub values: Vec<f64>,
    pub kind: Kind,
    pub array: bool,
}

/// Scalar type.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    Int,
    Uint,
    Float,
}

/// All constants of a file, by its text.
pub fn of(text: &str) -> Vec<Constant> {
    let mut known: BTreeMap<String, f64> = BTreeMap::new();
    let mut out = Vec::new();
    let mut depth = 0i32;
    let plain: Vec<&str> = text.lines().map(|l| l.split("//").next().unwrap_or_default().trim()).collect();
    let mut lines = plain.into_iter();
    while let Some(line) = lines.next() {
        let mut found = Vec::new();
        if let Some(rest) = line.strip_prefix("#define ") {
            if let Some((name, value)) = rest.trim().split_once(' ').filter(|(n, _)| !n.contains('(')) {
                found.extend(number(value.trim()).map(|(v, kind)| (name.to_owned(), vec![v], kind, false)));
            }
        } else if depth == 0 && line.starts_with("const ") {
            let mut statement = line.to_owned();
            while !statement.contains(';') {
                let Some(next) = lines.next() else { break };
                statement.push(' ');
                statement.push_str(next);
            }
            found = declared(&statement, &mut known);
        }
        for (name, values, kind, array) in found {
            if let [value] = values[..] {
                known.insert(name.clone(), value);
            }
            out.push(Constant { name, values, kind, array });
        }
        depth += line.matches('{').count() as i32 - line.matches('}').count() as i32;
    }
    out
}

type Found = (String, Vec<f64>, Kind, bool);

/// `const TYPE A = x, B[n] = y;`
fn declared(statement: &str, known: &mut BTreeMap<String, f64>) -> Vec<Found> {
    let body = statement.trim_start_matches("const ").split(';').next().unwrap_or_default();
    let Some((glsl_type, body)) = body.trim().split_once(' ') else { return Vec::new() };
    let kind = match glsl_type {
        "int" | "ivec2" | "ivec3" | "ivec4" => Kind::Int,
        "uint" | "uvec2" | "uvec3" | "uvec4" => Kind::Uint,
        "float" | "vec2" | "vec3" | "vec4" => Kind::Float,
        _ => return Vec::new(),
    };
    let mut out = Vec::new();
    for one in outside_brackets(body) {
        let Some((name, value)) = one.split_once('=') else { continue };
        let name = name.trim().split('[').next().unwrap_or_default().to_owned();
        let value = value.trim();
        let list = value.strip_suffix(')').and_then(|v| v.split_once('(')).filter(|(head, _)| {
            head.starts_with("vec")
                || head.starts_with("ivec")
                || head.starts_with("uvec")
                || head.ends_with("[]")
        });
        let parts = list.map_or_else(|| vec![value], |(_, inner)| outside_brackets(inner));
        let values: Option<Vec<f64>> = parts.iter().map(|p| evaluate(p, kind, known)).collect();
        if let Some(values) = values {
            if list.is_none() {
                known.insert(name.clone(), values[0]);
            }
            out.push((name, values, kind, list.is_some()));
        }
    }
    out
}

/// Splits at commas that no bracket encloses.
fn outside_brackets(text: &str) -> Vec<&str> {
    let (mut parts, mut depth, mut start) = (Vec::new(), 0, 0);
    for (i, c) in text.char_indices() {
        match c {
            '(' | '[' => depth += 1,
            ')' | ']' => depth -= 1,
            ',' if depth == 0 => {
                parts.push(text[start..i].trim());
                start = i + 1;
            }
            _ => {}
        }
    }
    parts.push(text[start..].trim());
    parts
}

/// A literal and the type that GLSL gives it.
fn number(text: &str) -> Option<(f64, Kind)> {
    if let Some(digits) = text.strip_suffix('u') {
        let value = match digits.strip_prefix("0x") {
            Some(hex) => u32::from_str_radix(hex, 16),
            None => digits.parse::<u32>(),
        };
        return value.ok().map(|v| (f64::from(v), Kind::Uint));
    }
    if let Ok(whole) = text.parse::<i32>() {
        return Some((f64::from(whole), Kind::Int));
    }
    let float = text.starts_with(|c: char| c.is_ascii_digit() || c == '-' || c == '.');
    text.parse::<f64>().ok().filter(|_| float).map(|v| (v, Kind::Float))
}

/// Sums of products from left to right; `None` where a name is not known or the form is another.
fn evaluate(text: &str, kind: Kind, known: &BTreeMap<String, f64>) -> Option<f64> {
    if let Some((v, _)) = number(text) {
        return Some(v);
    }
    let factor = |t: &str| number(t).map(|(v, _)| v).or_else(|| known.get(t).copied());
    let tokens: Vec<&str> = text.split_whitespace().collect();
    let (mut sum, mut product, mut sign) = (0.0, factor(tokens.first()?)?, 1.0);
    for pair in tokens[1..].chunks(2) {
        let &[operator, operand] = pair else { return None };
        let operand = factor(operand)?;
        match operator {
            "*" => product *= operand,
            "/" => product /= operand,
            "<<" if tokens.len() == 3 => product *= operand.exp2(),
            "+" | "-" => {
                sum += sign * product;
                (sign, product) = (if operator == "+" { 1.0 } else { -1.0 }, operand);
            }
            _ => return None,
        }
        if kind != Kind::Float {
            product = product.trunc();
        }
    }
    Some(sum + sign * product)
}

/// The Rust declarations. Floats come in f64 with the digits of the source, as the f64 twins need
/// them; `as f32` gives the value of the shader.
pub fn declarations(w: &mut String, file: &str, constants: &[Constant], indent: &str) {
    for c in constants {
        let (scalar, written): (&str, Vec<String>) = match c.kind {
            Kind::Int => ("i32", c.values.iter().map(|v| format!("{}", *v as i64)).collect()),
            Kind::Uint => ("u32", c.values.iter().map(|v| format!("{}", *v as u64)).collect()),
            Kind::Float => ("f64", c.values.iter().map(|v| format!("{v:?}")).collect()),
        };
        let _ = writeln!(w, "{indent}/// `{}` of `{file}`.", c.name);
        let _ = match c.array {
            false => writeln!(w, "{indent}pub const {}: {scalar} = {};", c.name, written[0]),
            true => writeln!(
                w,
                "{indent}pub const {}: [{scalar}; {}] = [{}];",
                c.name,
                written.len(),
                written.join(", ")
            ),
        };
    }
}
