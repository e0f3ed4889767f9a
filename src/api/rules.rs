//! Lines, zones and masks on the wire, and how they are changed.

use jiff::Timestamp;
use serde::de::{DeserializeOwned, Error, Unexpected};
use serde::{Deserialize, Deserializer, Serialize};

use crate::analytics::{Anchor, Counts, Line, Mask, MaskStyle, Point, RuleError, RuleId, Rules, Zone};

/// A line as it is sent. Unknown fields are refused.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LineSpec {
    /// Its name, unique among the camera's lines.
    pub id: String,
    /// 2 to 32 points `[x, y]` in fractions of the picture, from the top left.
    pub points: Vec<[f64; 2]>,
    /// What of a box crosses it.
    #[serde(default)]
    pub anchor: AnchorSpec,
}

/// A zone as it is sent. Unknown fields are refused.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ZoneSpec {
    /// Its name, unique among the camera's zones.
    pub id: String,
    /// 3 to 32 corners `[x, y]` in fractions of the picture, from the top left.
    pub points: Vec<[f64; 2]>,
    /// What of a box is in it.
    #[serde(default)]
    pub anchor: AnchorSpec,
    /// Who stays longer loiters, seconds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub loiter_s: Option<f64>,
    /// More than so many are a crowd.
    #[serde(default, deserialize_with = "whole", skip_serializing_if = "Option::is_none")]
    pub capacity: Option<u32>,
}

/// A whole number however it is written: to JSON `8.0` is 8, and some clients know no other numbers.
fn whole<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<u32>, D::Error> {
    let Some(number) = Option::<f64>::deserialize(deserializer)? else { return Ok(None) };
    let whole = number.fract() == 0.0 && (0.0..=f64::from(u32::MAX)).contains(&number);
    let expected = "a whole number from 0 to 4294967295";
    whole
        .then_some(Some(number as u32))
        .ok_or_else(|| D::Error::invalid_value(Unexpected::Float(number), &expected))
}

/// What of a box is held against lines and zones.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum AnchorSpec {
    /// The middle of its lower edge.
    #[default]
    Foot,
    /// Its centre.
    Centre,
}

/// A mask as it is sent. Unknown fields are refused.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MaskSpec {
    /// Its name, unique among the camera's masks.
    pub id: String,
    /// 3 to 32 corners `[x, y]` in fractions of the picture, from the top left.
    pub points: Vec<[f64; 2]>,
    /// How it hides.
    #[serde(default)]
    pub style: StyleSpec,
}

/// How a mask hides what is under it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum StyleSpec {
    /// Black.
    #[default]
    Fill,
    /// Coarse blocks.
    Pixelate,
}

/// All lines, zones and masks of a camera.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RulesSpec {
    /// Lines.
    #[serde(default)]
    pub lines: Vec<LineSpec>,
    /// Zones.
    #[serde(default)]
    pub zones: Vec<ZoneSpec>,
    /// Masks.
    #[serde(default)]
    pub masks: Vec<MaskSpec>,
}

/// A change of a camera's rules.
#[derive(Clone, Debug)]
pub enum RuleEdit {
    /// A new one; its name must be free.
    Add(Rule),
    /// A new one, or another in the place of the one of its name.
    Put(Rule),
    /// The line of that name goes.
    RemoveLine(RuleId),
    /// The zone of that name goes.
    RemoveZone(RuleId),
    /// The mask of that name goes.
    RemoveMask(RuleId),
}

/// One of a camera's rules.
#[derive(Clone, Debug)]
pub enum Rule {
    /// A line.
    Line(Line),
    /// A zone.
    Zone(Zone),
    /// A mask.
    Mask(Mask),
}

/// Why a change of the rules is refused.
#[derive(Debug, thiserror::Error)]
pub enum EditError {
    /// It cannot be watched.
    #[error(transparent)]
    Rule(#[from] RuleError),
    /// The name is taken.
    #[error("{0} exists; PUT replaces it")]
    Exists(RuleId),
    /// There is none of that name.
    #[error("there is no {what} {id:?} on this camera", id = id.as_str())]
    Unknown {
        /// `line`, `zone` or `mask`.
        what: &'static str,
        /// The name.
        id: RuleId,
    },
}

impl RuleEdit {
    /// `rules` with the change.
    ///
    /// # Errors
    /// [`EditError`]; `rules` are as they were then.
    pub fn apply(self, rules: &Rules) -> Result<Rules, EditError> {
        let mut rules = rules.clone();
        match self {
            RuleEdit::Add(Rule::Line(line)) => add(&mut rules.lines, line)?,
            RuleEdit::Add(Rule::Zone(zone)) => add(&mut rules.zones, zone)?,
            RuleEdit::Add(Rule::Mask(mask)) => add(&mut rules.masks, mask)?,
            RuleEdit::Put(Rule::Line(line)) => put(&mut rules.lines, line),
            RuleEdit::Put(Rule::Zone(zone)) => put(&mut rules.zones, zone),
            RuleEdit::Put(Rule::Mask(mask)) => put(&mut rules.masks, mask),
            RuleEdit::RemoveLine(id) => remove(&mut rules.lines, id)?,
            RuleEdit::RemoveZone(id) => remove(&mut rules.zones, id)?,
            RuleEdit::RemoveMask(id) => remove(&mut rules.masks, id)?,
        }
        rules.check()?;
        Ok(rules)
    }
}

trait Named {
    const WHAT: &'static str;
    fn id(&self) -> &RuleId;
}

impl Named for Line {
    const WHAT: &'static str = "line";
    fn id(&self) -> &RuleId {
        &self.id
    }
}

impl Named for Zone {
    const WHAT: &'static str = "zone";
    fn id(&self) -> &RuleId {
        &self.id
    }
}

impl Named for Mask {
    const WHAT: &'static str = "mask";
    fn id(&self) -> &RuleId {
        &self.id
    }
}

fn add<T: Named>(all: &mut Vec<T>, new: T) -> Result<(), EditError> {
    if all.iter().any(|old| old.id() == new.id()) {
        return Err(EditError::Exists(new.id().clone()));
    }
    all.push(new);
    Ok(())
}

fn put<T: Named>(all: &mut Vec<T>, new: T) {
    match all.iter_mut().find(|old| old.id() == new.id()) {
        Some(old) => *old = new,
        None => all.push(new),
    }
}

fn remove<T: Named>(all: &mut Vec<T>, id: RuleId) -> Result<(), EditError> {
    let before = all.len();
    all.retain(|rule| *rule.id() != id);
    if all.len() < before { Ok(()) } else { Err(EditError::Unknown { what: T::WHAT, id }) }
}

/// What lines, zones and masks have in common on the wire.
pub(super) trait Drawn: Clone + Serialize + DeserializeOwned + Send + Sync + 'static {
    const WHAT: &'static str;
    /// As the paths have it.
    const PLURAL: &'static str;

    fn of(rules: RulesSpec) -> Vec<Self>;
    fn name(&self) -> &str;
    fn rule(self) -> Result<Rule, RuleError>;
    fn removal(id: RuleId) -> RuleEdit;
}

impl Drawn for LineSpec {
    const WHAT: &'static str = Line::WHAT;
    const PLURAL: &'static str = "lines";

    fn of(rules: RulesSpec) -> Vec<Self> {
        rules.lines
    }

    fn name(&self) -> &str {
        &self.id
    }

    fn rule(self) -> Result<Rule, RuleError> {
        self.try_into().map(Rule::Line)
    }

    fn removal(id: RuleId) -> RuleEdit {
        RuleEdit::RemoveLine(id)
    }
}

impl Drawn for ZoneSpec {
    const WHAT: &'static str = Zone::WHAT;
    const PLURAL: &'static str = "zones";

    fn of(rules: RulesSpec) -> Vec<Self> {
        rules.zones
    }

    fn name(&self) -> &str {
        &self.id
    }

    fn rule(self) -> Result<Rule, RuleError> {
        self.try_into().map(Rule::Zone)
    }

    fn removal(id: RuleId) -> RuleEdit {
        RuleEdit::RemoveZone(id)
    }
}

impl Drawn for MaskSpec {
    const WHAT: &'static str = Mask::WHAT;
    const PLURAL: &'static str = "masks";

    fn of(rules: RulesSpec) -> Vec<Self> {
        rules.masks
    }

    fn name(&self) -> &str {
        &self.id
    }

    fn rule(self) -> Result<Rule, RuleError> {
        self.try_into().map(Rule::Mask)
    }

    fn removal(id: RuleId) -> RuleEdit {
        RuleEdit::RemoveMask(id)
    }
}

impl From<StyleSpec> for MaskStyle {
    fn from(style: StyleSpec) -> Self {
        match style {
            StyleSpec::Fill => MaskStyle::Fill,
            StyleSpec::Pixelate => MaskStyle::Pixelate,
        }
    }
}

impl From<MaskStyle> for StyleSpec {
    fn from(style: MaskStyle) -> Self {
        match style {
            MaskStyle::Fill => StyleSpec::Fill,
            MaskStyle::Pixelate => StyleSpec::Pixelate,
        }
    }
}

impl From<AnchorSpec> for Anchor {
    fn from(anchor: AnchorSpec) -> Self {
        match anchor {
            AnchorSpec::Foot => Anchor::Foot,
            AnchorSpec::Centre => Anchor::Centre,
        }
    }
}

impl From<Anchor> for AnchorSpec {
    fn from(anchor: Anchor) -> Self {
        match anchor {
            Anchor::Foot => AnchorSpec::Foot,
            Anchor::Centre => AnchorSpec::Centre,
        }
    }
}

fn points(points: Vec<[f64; 2]>) -> Vec<Point> {
    points.into_iter().map(|[x, y]| Point { x, y }).collect()
}

fn pairs(points: &[Point]) -> Vec<[f64; 2]> {
    points.iter().map(|p| [p.x, p.y]).collect()
}

impl TryFrom<LineSpec> for Line {
    type Error = RuleError;

    fn try_from(spec: LineSpec) -> Result<Self, RuleError> {
        Ok(Self { id: RuleId::new(&spec.id)?, points: points(spec.points), anchor: spec.anchor.into() })
    }
}

impl TryFrom<ZoneSpec> for Zone {
    type Error = RuleError;

    fn try_from(spec: ZoneSpec) -> Result<Self, RuleError> {
        let ZoneSpec { id, points: corners, anchor, loiter_s, capacity } = spec;
        let id = RuleId::new(&id)?;
        Ok(Self { id, points: points(corners), anchor: anchor.into(), loiter: loiter_s, capacity })
    }
}

impl TryFrom<MaskSpec> for Mask {
    type Error = RuleError;

    fn try_from(spec: MaskSpec) -> Result<Self, RuleError> {
        Ok(Self { id: RuleId::new(&spec.id)?, points: points(spec.points), style: spec.style.into() })
    }
}

impl From<&Mask> for MaskSpec {
    fn from(mask: &Mask) -> Self {
        Self { id: mask.id.to_string(), points: pairs(&mask.points), style: mask.style.into() }
    }
}

impl From<&Line> for LineSpec {
    fn from(line: &Line) -> Self {
        Self { id: line.id.to_string(), points: pairs(&line.points), anchor: line.anchor.into() }
    }
}

impl From<&Zone> for ZoneSpec {
    fn from(zone: &Zone) -> Self {
        Self {
            id: zone.id.to_string(),
            points: pairs(&zone.points),
            anchor: zone.anchor.into(),
            loiter_s: zone.loiter,
            capacity: zone.capacity,
        }
    }
}

impl RulesSpec {
    /// What is drawn.
    ///
    /// # Errors
    /// [`RuleError`], of the first that cannot be.
    pub fn rules(self) -> Result<Rules, RuleError> {
        let rules = Rules {
            lines: self.lines.into_iter().map(Line::try_from).collect::<Result<_, _>>()?,
            zones: self.zones.into_iter().map(Zone::try_from).collect::<Result<_, _>>()?,
            masks: self.masks.into_iter().map(Mask::try_from).collect::<Result<_, _>>()?,
        };
        rules.check()?;
        Ok(rules)
    }
}

impl From<&Rules> for RulesSpec {
    fn from(rules: &Rules) -> Self {
        Self {
            lines: rules.lines.iter().map(LineSpec::from).collect(),
            zones: rules.zones.iter().map(ZoneSpec::from).collect(),
            masks: rules.masks.iter().map(MaskSpec::from).collect(),
        }
    }
}

/// What a camera's analytics have found.
#[derive(Clone, Debug)]
pub struct Findings {
    /// Since when.
    pub since: Timestamp,
    /// Crossings, occupancies.
    pub counts: Counts,
}
