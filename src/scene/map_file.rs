//! `maps` of a `[[cloth]]` of the TOML scene format, and the images that it names.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;
use std::sync::Arc;

use super::SceneError;
use super::fields::{Fields, Value};
use super::files::find;
use super::maps::{Image, MapSource, Quantity, Values};

const MAP_FIELDS: [&str; 4] = ["property", "image", "from", "to"];

/// Most pixels of an image.
const PIXELS_MOST: u64 = 1 << 26;

/// Reads the `maps` of a cloth of the scene `path`.
pub(super) fn maps(fields: &Fields, path: &Path) -> Result<Vec<MapSource>, SceneError> {
    let names = Quantity::ALL.map(Quantity::name);
    let table = fields.table("maps", &names)?;
    let mut maps = Vec::new();
    for quantity in Quantity::ALL {
        let Some(value) = table.get(quantity.name()) else { continue };
        maps.push(map(quantity, &value, path)?);
    }
    Ok(maps)
}

fn map(quantity: Quantity, value: &Value, path: &Path) -> Result<MapSource, SceneError> {
    let at = value.place();
    if value.is_text() {
        let values = Values::Property(value.text()?.to_owned());
        return Ok(MapSource { quantity, values, factors: [0.0, 1.0], at });
    }
    let table = value.table(&MAP_FIELDS)?;
    let values = match (table.get("property"), table.get("image")) {
        (Some(property), None) => Values::Property(property.text()?.to_owned()),
        (None, Some(image)) => {
            let found = find(path, image.text()?).map_err(|what| image.error(what))?;
            Values::Image(Arc::new(read_image(&found)?))
        }
        _ => return Err(value.error("a map needs a `property` or an `image`")),
    };
    let factors = [table.or("from", 0.0, Value::number)?, table.or("to", 1.0, Value::number)?];
    Ok(MapSource { quantity, values, factors, at })
}

/// The brightness of a PNG: gray, or the mean of red, green and blue; transparency does not count.
fn read_image(path: &Path) -> Result<Image, SceneError> {
    let fault = |what: String| SceneError::File { path: path.into(), what };
    let file = File::open(path).map_err(|error| fault(format!("cannot be read: {error}")))?;
    let mut decoder = png::Decoder::new(BufReader::new(file));
    decoder.set_transformations(png::Transformations::EXPAND);
    let not_png = |error: png::DecodingError| fault(format!("is not a PNG image that can be read: {error}"));
    let mut reader = decoder.read_info().map_err(not_png)?;
    let (width, height) = (reader.info().width as usize, reader.info().height as usize);
    if width as u64 * height as u64 > PIXELS_MOST {
        return Err(fault(format!("has {width} x {height} pixels; at most {PIXELS_MOST} are read")));
    }
    let size = reader.output_buffer_size().ok_or_else(|| fault("is too large".into()))?;
    let mut bytes = vec![0; size];
    let info = reader.next_frame(&mut bytes).map_err(not_png)?;
    let samples: Vec<f32> = match info.bit_depth {
        png::BitDepth::Sixteen => {
            bytes.as_chunks().0.iter().map(|&pair| f32::from(u16::from_be_bytes(pair)) / 65535.0).collect()
        }
        _ => bytes.iter().map(|&byte| f32::from(byte) / 255.0).collect(),
    };
    let channels = info.color_type.samples();
    let brightness = |pixel: &[f32]| if channels >= 3 { (pixel[0] + pixel[1] + pixel[2]) / 3.0 } else { pixel[0] };
    let values: Vec<f32> = samples.chunks_exact(channels).take(width * height).map(brightness).collect();
    Ok(Image { width, height, values })
}
