//! Changes of a scene that keep its mesh: forces, friction, fabrics, pins.

use super::cloth_file::known_fabric;
use super::{Edit, Fabric, FabricEdit, Handles, Of, Scene, SceneError};
use crate::math::Vec3;

/// Density of the air of a scene that begins to have wind, as `[air]` has it, kg/m^3.
const AIR_DENSITY_KG_M3: f64 = 1.2;

impl Scene {
    /// Makes a change that keeps the mesh, and of `handles` what follows from it. False if it is not one of those.
    ///
    /// # Errors
    /// A sentence; the scene may then be changed in part and must not be used.
    pub fn edit(&mut self, handles: &mut Handles, edit: &Edit) -> Result<bool, String> {
        match edit {
            Edit::Gravity(gravity_m_s2) => self.set_gravity(*gravity_m_s2),
            Edit::Wind { wind_m_s, density_kg_m3, drag_kg_m2_s } => {
                let settings = &mut self.settings;
                settings.wind_m_s = *wind_m_s;
                settings.over_time.wind_m_s = None;
                // A scene without `[air]` has none, so wind alone would do nothing.
                let is_airless = settings.air_density_kg_m3 == 0.0 && settings.air_drag_kg_m2_s == 0.0;
                let given = density_kg_m3.or(is_airless.then_some(AIR_DENSITY_KG_M3));
                settings.air_density_kg_m3 = given.unwrap_or(settings.air_density_kg_m3);
                settings.air_drag_kg_m2_s = drag_kg_m2_s.unwrap_or(settings.air_drag_kg_m2_s);
            }
            Edit::Friction { of, friction } => self.set_friction(handles, of, *friction)?,
            Edit::Fabric { of, fabric } => self.set_fabric(handles, of, fabric)?,
            Edit::Unpin { pin } => self.unpin(handles, pin)?,
            Edit::Unsew { name } => self.unsew(name)?,
            Edit::Threads { gaps_m } => self.restart_threads(gaps_m),
            Edit::Sew(_) | Edit::Refine { .. } | Edit::Welded => return Ok(false),
        }
        Ok(true)
    }

    /// Panels that are sewn get their weight at once, too.
    fn set_gravity(&mut self, gravity_m_s2: Vec3) {
        self.settings.gravity_m_s2 = gravity_m_s2;
        self.settings.over_time.gravity_m_s2 = None;
        if let Some(sewing) = &mut self.sewing {
            sewing.gravity_m_s2 = gravity_m_s2;
        }
    }

    fn set_friction(&mut self, handles: &Handles, of: &Of, friction: f64) -> Result<(), String> {
        match of {
            Of::Cloth(name) => {
                let number = handles.cloth(name)?;
                match self.cloths.get_mut(number) {
                    Some(cloth) => cloth.friction = friction,
                    None => self.settings.friction = friction,
                }
            }
            Of::Obstacle(name) => {
                let known: Vec<String> = self.obstacles.iter().map(|obstacle| obstacle.name.clone()).collect();
                let known = if known.is_empty() { "the scene has none".to_owned() } else { known.join(", ") };
                let found = self.obstacles.iter_mut().find(|obstacle| obstacle.name == *name);
                found.ok_or_else(|| format!("no obstacle is named `{name}` ({known})"))?.friction = friction;
            }
            Of::All | Of::Fabric(_) => {
                self.settings.friction = friction;
                self.cloths.iter_mut().for_each(|cloth| cloth.friction = friction);
                self.obstacles.iter_mut().for_each(|obstacle| obstacle.friction = friction);
            }
        }
        Ok(())
    }

    fn set_fabric(&mut self, handles: &Handles, of: &Of, edit: &FabricEdit) -> Result<(), String> {
        let other = match &edit.fabric {
            None => None,
            Some(name) => {
                let fault = |what: String| SceneError::File { path: handles.path.clone(), what };
                let found = known_fabric(name, &handles.fabrics, &handles.path, &fault);
                Some(found.map_err(|error| error.what())?)
            }
        };
        let edited = |fabric: &Fabric| -> Result<Fabric, String> {
            let fabric = match &other {
                // The state of a run holds what has yielded, so what can yield stays.
                Some(other) => Fabric {
                    plasticity: fabric.plasticity,
                    strain_limit: fabric.strain_limit,
                    damping_s: fabric.damping_s,
                    ..other.clone()
                },
                None => fabric.clone(),
            };
            let fabric = Fabric {
                density_kg_m2: edit.density_kg_m2.unwrap_or(fabric.density_kg_m2),
                stretching_n_m: edit.stretching_n_m.unwrap_or(fabric.stretching_n_m),
                bending_n_m: edit.bending_n_m.unwrap_or(fabric.bending_n_m),
                damping_s: edit.damping_s.unwrap_or(fabric.damping_s),
                ..fabric
            };
            fabric.check().map(|()| fabric)
        };
        let of_cloth = match of {
            Of::Cloth(name) => self.cloths.get(handles.cloth(name)?).map(|cloth| cloth.triangles.clone()),
            _ => None,
        };
        let mut any = false;
        let mut fabrics: Vec<Fabric> = Vec::new();
        // Number of the new fabric of a triangle, by the number of the old one and whether it is changed.
        let mut numbers: Vec<[Option<u16>; 2]> = vec![[None; 2]; self.fabrics.len()];
        for (triangle, number) in (0u32..).zip(&mut self.fabric_of_triangle) {
            let old = usize::from(*number);
            let changes = match of {
                Of::Cloth(_) => of_cloth.as_ref().is_none_or(|triangles| triangles.contains(&triangle)),
                Of::Fabric(name) => self.fabrics[old].name == *name,
                Of::All | Of::Obstacle(_) => true,
            };
            any |= changes;
            *number = match numbers[old][usize::from(changes)] {
                Some(known) => known,
                None => {
                    let fabric = if changes { edited(&self.fabrics[old])? } else { self.fabrics[old].clone() };
                    let there = fabrics.iter().position(|other| *other == fabric);
                    let place = there.unwrap_or(fabrics.len());
                    if there.is_none() {
                        fabrics.push(fabric);
                    }
                    let place = u16::try_from(place).map_err(|_| "there are more than 65536 different fabrics")?;
                    numbers[old][usize::from(changes)] = Some(place);
                    place
                }
            };
        }
        if let (false, Of::Fabric(name)) = (any, of) {
            let mut known: Vec<&str> = self.fabrics.iter().map(|fabric| &fabric.name[..]).collect();
            known.dedup();
            return Err(format!("no cloth is of the fabric `{name}` ({})", known.join(", ")));
        }
        self.fabrics = fabrics;
        Ok(())
    }

    /// Lets the vertices of a pin go that no other one holds.
    fn unpin(&mut self, handles: &mut Handles, name: &str) -> Result<(), String> {
        let known = || match handles.pins.is_empty() {
            true => "no pin holds".to_owned(),
            false => handles.pins.iter().map(|pin| &pin.name[..]).collect::<Vec<_>>().join(", "),
        };
        let place = handles.pins.iter().position(|pin| pin.name == name);
        let place = place.ok_or_else(|| format!("no pin is named `{name}` ({})", known()))?;
        let free = handles.pins.remove(place).vertices;
        let mut held: Vec<u32> = handles.pins.iter().flat_map(|pin| pin.vertices.iter().copied()).collect();
        held.sort_unstable();
        self.pins.retain(|pin| !free.contains(&pin.vertex) || held.binary_search(&pin.vertex).is_ok());
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::super::{Overrides, read_str};
    use super::*;

    fn scene() -> (Scene, Handles) {
        let text = r#"
[[fabric]]
name = "mine"
density_kg_m2 = 0.3
stretching_n_m = [100, 10, 100, 20]
bending_n_m = 1e-5
[[cloth]]
name = "one"
sheet = { size_m = [1, 1], triangles = 32, mesh = "grid" }
fabric = "silk"
[[cloth]]
name = "two"
sheet = { size_m = [1, 1], triangles = 32, mesh = "grid" }
origin_m = [0, 0, 1]
fabric = "silk"
[[pin]]
name = "corner"
cloth = "one"
corners = ["top-left"]
[[pin]]
cloth = "one"
edge = "top"
[[obstacle]]
name = "floor"
plane = { point_m = [0, -1, 0], normal = [0, 1, 0], size_m = [4, 4] }
"#;
        let parsed = read_str(text, Path::new("x.toml")).unwrap();
        let overrides = Overrides::default();
        (parsed.at(&overrides).unwrap(), parsed.handles(&overrides).unwrap())
    }

    #[test]
    fn wind_brings_air_and_gravity_and_friction_reach_all() {
        let (mut scene, mut handles) = scene();
        let wind = Edit::Wind { wind_m_s: Vec3::X, density_kg_m3: None, drag_kg_m2_s: None };
        assert_eq!(scene.edit(&mut handles, &wind), Ok(true));
        assert_eq!((scene.settings.wind_m_s, scene.settings.air_density_kg_m3), (Vec3::X, 1.2));
        scene.edit(&mut handles, &Edit::Gravity(Vec3::Z)).unwrap();
        assert_eq!(scene.settings.gravity_m_s2, Vec3::Z);
        let friction = |of: Of| Edit::Friction { of, friction: 0.7 };
        scene.edit(&mut handles, &friction(Of::Cloth("two".into()))).unwrap();
        assert_eq!([scene.cloths[0].friction, scene.cloths[1].friction], [0.3, 0.7]);
        scene.edit(&mut handles, &friction(Of::All)).unwrap();
        assert_eq!((scene.cloths[0].friction, scene.obstacles[0].friction), (0.7, 0.7));
        let error = scene.edit(&mut handles, &friction(Of::Obstacle("roof".into()))).unwrap_err();
        assert_eq!(error, "no obstacle is named `roof` (floor)");
        assert_eq!(scene.edit(&mut handles, &Edit::Refine { times: 1 }), Ok(false));
    }

    #[test]
    fn a_fabric_changes_where_it_is_asked_to() {
        let (mut scene, mut handles) = scene();
        let light = FabricEdit { density_kg_m2: Some(0.01), ..FabricEdit::default() };
        let edit = |of: Of, fabric: FabricEdit| Edit::Fabric { of, fabric };
        scene.edit(&mut handles, &edit(Of::Cloth("two".into()), light.clone())).unwrap();
        let density = |scene: &Scene, cloth: usize| {
            let triangle = scene.cloths[cloth].triangles.start as usize;
            scene.fabrics[usize::from(scene.fabric_of_triangle[triangle])].density_kg_m2
        };
        assert_eq!((density(&scene, 0), density(&scene, 1), scene.fabrics.len()), (0.06, 0.01, 2));
        let mine = FabricEdit { fabric: Some("mine".into()), ..FabricEdit::default() };
        scene.edit(&mut handles, &edit(Of::Fabric("silk".into()), mine)).unwrap();
        assert_eq!((density(&scene, 0), scene.fabrics.len()), (0.3, 1));
        let error = scene.edit(&mut handles, &edit(Of::Fabric("silk".into()), light)).unwrap_err();
        assert_eq!(error, "no cloth is of the fabric `silk` (mine)");
        let missing = FabricEdit { fabric: Some("coton".into()), ..FabricEdit::default() };
        let error = scene.edit(&mut handles, &edit(Of::All, missing)).unwrap_err();
        assert!(error.contains("`coton` is no known fabric; known: mine, cotton"), "{error}");
    }

    #[test]
    fn a_pin_lets_go_what_no_other_one_holds() {
        let (mut scene, mut handles) = scene();
        assert_eq!(handles.pins.iter().map(|pin| &pin.name[..]).collect::<Vec<_>>(), ["corner", "1"]);
        let before = scene.pins.len();
        scene.edit(&mut handles, &Edit::Unpin { pin: "corner".into() }).unwrap();
        assert_eq!(scene.pins.len(), before, "the edge holds the corner");
        scene.edit(&mut handles, &Edit::Unpin { pin: "1".into() }).unwrap();
        assert!(scene.pins.is_empty());
        let error = scene.edit(&mut handles, &Edit::Unpin { pin: "1".into() }).unwrap_err();
        assert_eq!(error, "no pin is named `1` (no pin holds)");
    }
}
