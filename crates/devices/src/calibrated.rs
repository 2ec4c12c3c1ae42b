//! A calibration goes back into the files that it came from: joint origins into the URDF.
//!
//! In: the URDF as it was read and a chain with the fixed transforms as they really are. Out: the URDF's
//! text with the origins of three joints replaced, the pan joint's, the tilt joint's and that of the first
//! fixed joint behind it. All else, comments and foreign elements included, stays as it is. The text is
//! read back, and refused unless it gives the chain that was asked for.

use std::path::Path;

use vergence_geometry::{Chain, Transform};

use crate::description::{Description, DescriptionError, transform};

/// Largest difference (rad, m) between the chain asked for and the one read back.
const ROUNDING: f64 = 1e-6;

/// Why a calibration could not be written into a URDF.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    /// The description lacks the chain.
    #[error(transparent)]
    Description(#[from] DescriptionError),
    /// The camera is fixed to the tilt joint's link without a joint that could take its pose.
    #[error("the URDF has no fixed joint between the joint \"{0}\" and the link \"{1}\"")]
    NoMount(String, String),
    /// The joint is written in a way that is not understood (a macro, for example).
    #[error("cannot replace the origin of the URDF's joint \"{0}\"")]
    NotFound(String),
}

impl Description {
    /// The URDF with the moving joints' and the tip's fixed transforms of `chain`, which runs from
    /// `root` to `tip` like the one that the description has.
    pub fn with_chain(&self, root: &str, tip: &str, chain: &Chain) -> Result<Self, WriteError> {
        let mut text = self.text.clone();
        // Origins from the root to the tip: of each fixed joint, `None` where one is to be found.
        let mut pending = Transform::identity();
        let mut wanted = chain.joints.iter();
        let path = self.path(root, tip)?;
        let mut mount = None;
        for (index, joint) in path.iter().enumerate() {
            if joint.joint_type != urdf_rs::JointType::Fixed {
                let Some(calibrated) = wanted.next() else {
                    return Err(WriteError::NotFound(joint.name.clone()));
                };
                let origin = pending.inverse() * calibrated.parent_from_joint;
                text = replace_origin(&text, &joint.name, &origin)?;
                pending = Transform::identity();
                mount = Some(index + 1);
            } else {
                pending *= transform(&joint.origin);
            }
        }
        let last = chain.joints.last().map_or(root, |joint| joint.name.as_str());
        let Some(first) = mount.and_then(|at| path.get(at)) else {
            return Err(WriteError::NoMount(last.into(), tip.into()));
        };
        // What hangs behind the first fixed joint stays: it turns the body's axes to the optical ones.
        let behind = transform(&first.origin).inverse() * pending;
        let origin = chain.last_from_tip * behind.inverse();
        text = replace_origin(&text, &first.name, &origin)?;
        let written = Description::parse(&text, Path::new("calibrated URDF"))?;
        match same(&written.chain(root, tip)?, chain) {
            true => Ok(written),
            false => Err(WriteError::NotFound(first.name.clone())),
        }
    }
}

fn same(a: &Chain, b: &Chain) -> bool {
    let near = |a: &Transform, b: &Transform| {
        let off = a.inverse() * b;
        off.translation.vector.norm() < ROUNDING && off.rotation.angle() < ROUNDING
    };
    let joints = a.joints.len() == b.joints.len()
        && a.joints.iter().zip(&b.joints).all(|(a, b)| {
            near(&a.parent_from_joint, &b.parent_from_joint)
                && (a.axis.into_inner() - b.axis.into_inner()).norm() < ROUNDING
        });
    joints && near(&a.last_from_tip, &b.last_from_tip)
}

/// The text with another origin in the joint of this name.
fn replace_origin(text: &str, joint: &str, origin: &Transform) -> Result<String, WriteError> {
    let not_found = || WriteError::NotFound(joint.into());
    let bare = without_comments(text);
    let element = elements(&bare, "joint")
        .find(|range| attribute(opening(&bare[range.clone()]), "name") == Some(joint))
        .ok_or_else(not_found)?;
    let (roll, pitch, yaw) = origin.rotation.euler_angles();
    let p = origin.translation.vector;
    let new = format!(
        "<origin xyz=\"{:.9} {:.9} {:.9}\" rpy=\"{roll:.9} {pitch:.9} {yaw:.9}\"/>",
        p.x, p.y, p.z
    );
    let inside = &bare[element.clone()];
    let (from, to) = match elements(inside, "origin").next() {
        Some(range) => (element.start + range.start, element.start + range.end),
        None => {
            let after = element.start + opening(inside).len();
            (after, after)
        }
    };
    Ok(format!("{}{new}{}", &text[..from], &text[to..]))
}

/// The text with its comments blanked, byte for byte as long.
fn without_comments(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(start) = rest.find("<!--") {
        let end = rest[start..].find("-->").map_or(rest.len(), |end| start + end + 3);
        out.push_str(&rest[..start]);
        out.extend(std::iter::repeat_n(' ', end - start));
        rest = &rest[end..];
    }
    out + rest
}

/// Ranges of the elements of a name that are not inside one another.
fn elements<'a>(
    text: &'a str,
    name: &'a str,
) -> impl Iterator<Item = std::ops::Range<usize>> + use<'a> {
    let mut at = 0;
    std::iter::from_fn(move || {
        loop {
            let start = at + text[at..].find(&format!("<{name}"))?;
            let head = opening(&text[start..]);
            at = start + head.len().max(1);
            let next = head[1 + name.len()..].chars().next();
            if !next.is_some_and(|c| c.is_whitespace() || c == '>' || c == '/') {
                continue;
            }
            let close = format!("</{name}>");
            let end = match head.ends_with("/>") {
                true => at,
                false => at + text[at..].find(&close)? + close.len(),
            };
            at = end;
            return Some(start..end);
        }
    })
}

/// The opening tag at the start of a text.
fn opening(text: &str) -> &str {
    text.find('>').map_or(text, |end| &text[..=end])
}

fn attribute<'a>(tag: &'a str, name: &str) -> Option<&'a str> {
    for quote in ['"', '\''] {
        let key = format!(" {name}={quote}");
        if let Some(start) = tag.find(&key) {
            return tag[start + key.len()..].split(quote).next();
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;
    use vergence_geometry::gaussian::perturb;

    const URDF: &str = r#"<robot name="r"><link name="base"/><link name="mast"/><link name="pan"/>
        <!-- <joint name="p" type="revolute"><origin xyz="9 9 9"/></joint> ä -->
        <link name="tilt"/><link name="eye"/><link name="optical"/>
        <joint name="m" type="fixed"><parent link="base"/><child link="mast"/><origin xyz="0 0.1 0.5" rpy="0 0 0.2"/></joint>
        <joint type='revolute' name='p'><parent link="mast"/><child link="pan"/><axis xyz="0 0 1"/>
          <limit lower="-1" upper="1" velocity="3.6" effort="1"/></joint>
        <joint name="t" type="revolute"><parent link="pan"/><child link="tilt"/><axis xyz="0 1 0"/>
          <origin xyz="0.02 0 0"></origin><limit lower="-1" upper="1" velocity="3.6" effort="1"/></joint>
        <joint name="e" type="fixed"><parent link="tilt"/><child link="eye"/><origin xyz="0.01 0 0.02"/></joint>
        <joint name="o" type="fixed"><parent link="eye"/><child link="optical"/>
          <origin rpy="-1.5707963267948966 0 -1.5707963267948966"/></joint><vendor keep="this"/></robot>"#;

    #[test]
    fn a_chain_comes_back_as_it_was_written() {
        let description = Description::parse(URDF, Path::new("r.urdf")).unwrap();
        let mut chain = description.chain("base", "optical").unwrap();
        let bend = |k: f64| nalgebra::Vector6::from_fn(|i, _| 0.01 * (k + i as f64) * (1.0 - k));
        for (k, joint) in chain.joints.iter_mut().enumerate() {
            joint.parent_from_joint = perturb(&joint.parent_from_joint, &bend(2.0 + k as f64));
        }
        chain.last_from_tip = perturb(&chain.last_from_tip, &bend(-1.0));
        let written = description.with_chain("base", "optical", &chain).unwrap();
        assert!(same(&written.chain("base", "optical").unwrap(), &chain));
        assert!(written.text.contains("<vendor keep=\"this\"/>"), "foreign elements stay");
        assert!(written.text.contains("xyz=\"9 9 9\""), "comments stay");
        // What no joint moves against is not touched.
        assert!(written.text.contains("xyz=\"0 0.1 0.5\" rpy=\"0 0 0.2\""));
    }

    #[test]
    fn a_camera_without_a_mount_is_told() {
        let description = Description::parse(URDF, Path::new("r.urdf")).unwrap();
        let chain = description.chain("base", "tilt").unwrap();
        let error = description.with_chain("base", "tilt", &chain).unwrap_err();
        assert!(matches!(error, WriteError::NoMount(j, l) if j == "t" && l == "tilt"));
    }
}
